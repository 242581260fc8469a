"""Poses that BEVGlue finds, in a batch of OpenCOOD, CoAlign or HEAL in place of those of the localisation."""

from cobevglue import SE2, BEVGlue
from cobevglue.interop import normalized_affine, pairwise_t_matrix
from cobevglue.simulation import Junction, JunctionSettings


def main() -> None:
    frame = Junction(seed=1, settings=JunctionSettings(agents=3))[0]
    detections = {name: view.boxes for name, view in frame.agents.items()}  # a detector's boxes, one list per agent

    # The recipe. Agents without a pose are left out of the sample, with their features.
    ego, *others = detections
    alignments = {name: BEVGlue().align(detections[ego], detections[name]) for name in others}
    poses = {ego: SE2()} | {n: a.ego_SE2_other for n, a in alignments.items() if a.ego_SE2_other is not None}
    pairwise = pairwise_t_matrix([list(poses.values())], max_agents=5, left_handed=False)
    batch = {"record_len": [len(poses)], "pairwise_t_matrix": pairwise}
    affine = normalized_affine(pairwise, height=100, width=352, cell=0.8)  # of the feature map

    print("agents in the sample:", ", ".join(poses))
    print("record_len:", batch["record_len"], "pairwise_t_matrix:", pairwise.shape, "affine:", affine.shape)
    for number, name in enumerate(poses):
        truth = SE2() if name == ego else frame.ego_SE2_other(ego, name)
        distance, _ = SE2.from_matrix(pairwise[0, number, 0]).error_to(truth)
        print(f"{name}: {distance:.2f} m off")


if __name__ == "__main__":
    main()
