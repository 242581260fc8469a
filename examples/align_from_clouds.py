"""Two simulated cars drive through traffic: vehicles are detected in clouds, and BEVGlue finds where the other car is.

pip install 'cobevglue[perception,simulation]'
python examples/align_from_clouds.py
"""

import math

import numpy as np

from cobevglue import SE2, BEVGlue
from cobevglue.perception import Perception, PointPillars
from cobevglue.simulation.scenario import ScenarioSettings, SimulatedScenario


def main() -> None:
    drive = SimulatedScenario("junction_test_0", seed=1, settings=ScenarioSettings(frames=5, agents=2))
    detector = PointPillars.pretrained("compact")
    ego, other = Perception(detector), Perception(detector)
    glue = BEVGlue()
    for frame in drive:
        first, second = frame.agents.values()
        assert first.points is not None
        assert second.points is not None
        alignment = glue.align(ego.step(first.points).boxes, other.step(second.points).boxes, time=frame.time)
        truth = SE2.from_matrix(np.linalg.inv(first.world_SE3_lidar) @ second.world_SE3_lidar)
        if alignment.ego_SE2_other is None:
            print(f"{frame.time:.1f} s: refused: {alignment.reason}")
        else:
            distance, turn = alignment.ego_SE2_other.error_to(truth)
            print(
                f"{frame.time:.1f} s: {len(alignment.matches)} common vehicles, "
                f"off by {distance:.2f} m and {math.degrees(turn):.2f} degrees"
            )


if __name__ == "__main__":
    main()
