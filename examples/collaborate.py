"""Three simulated cars see together: what one finds alone, and with the others' features at poses that BEVGlue finds.

pip install 'cobevglue[perception,simulation]'
python examples/collaborate.py
"""

import math

import numpy as np

from cobevglue import SE2, CoBEVGlue
from cobevglue.evaluation.detection import DetectionFrame, evaluate_detections
from cobevglue.simulation.scenario import ScenarioSettings, SimulatedScenario


def main() -> None:
    drive = SimulatedScenario("junction_test_0", seed=1, settings=ScenarioSettings(frames=4, agents=3))
    system = CoBEVGlue.pretrained("compact", fusion="cobevglue", aligner="bevglue")
    alone, together = [], []
    for frame in drive:
        out = system.step({name: agent.points for name, agent in frame.agents.items()}, ego="car1", time=frame.time)
        truth = frame.ground_truth("car1")
        together.append(DetectionFrame(out.boxes, truth))
        alone.append(DetectionFrame(system.detector.detect(frame.agents["car1"].points), truth))
        for name, alignment in out.alignments.items():
            if alignment.ego_SE2_other is not None:
                pose = np.linalg.inv(frame.agents["car1"].world_SE3_lidar) @ frame.agents[name].world_SE3_lidar
                distance, turn = alignment.ego_SE2_other.error_to(SE2.from_matrix(pose))
                print(
                    f"{frame.time:.1f} s: {name} sent {out.message_bytes[name]} bytes; "
                    f"off by {distance:.2f} m, {math.degrees(turn):.2f} degrees"
                )
    for title, frames in (("alone", alone), ("together", together)):
        report = evaluate_detections(frames, evaluation_range=(-70.0, 70.0, -39.0, 39.0))
        print(f"{title}: AP 0.5 is {report.ap(0.5):.3f}, AP 0.7 is {report.ap(0.7):.3f}")


if __name__ == "__main__":
    main()
