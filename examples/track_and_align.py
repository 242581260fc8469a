"""Track what two cars detect, and align them frame by frame: BEVGlue remembers what it found before."""

from cobevglue import BEVGlue
from cobevglue.simulation import Junction
from cobevglue.tracking import Sort


def main() -> None:
    car1, car2 = Sort(), Sort()  # one tracker per car
    glue = BEVGlue()  # one aligner per collaborator
    for frame in Junction(seed=1):
        ego = car1.update(frame.agents["car1"].boxes, time=frame.time)
        other = car2.update(frame.agents["car2"].boxes, time=frame.time)
        alignment = glue.align(ego, other, time=frame.time)
        if frame.index % 10:
            continue
        if alignment.ego_SE2_other is None:
            print(f"{frame.time:.1f} s: refused, {alignment.reason}")
        else:
            error, _ = alignment.ego_SE2_other.error_to(frame.ego_SE2_other("car1", "car2"))
            print(f"{frame.time:.1f} s: {len(alignment.matches)} common objects, {error:.2f} m off")


if __name__ == "__main__":
    main()
