"""Where is the other car? Two hand-written object lists, three lines to the relative pose."""

from collections.abc import Sequence

from cobevglue import BEVGlue, Boxes

# x, y, z [m], length, width, height [m], heading [rad] of what each car sees, in its own frame.
EGO = [
    (12.1, 3.4, -1.0, 4.5, 1.9, 1.5, 0.02),
    (25.3, -3.6, -1.0, 4.3, 1.8, 1.5, 3.12),
    (-8.2, 7.1, -0.4, 9.1, 2.5, 3.2, 0.01),
    (18.6, 14.8, -1.0, 4.7, 1.9, 1.5, 1.58),
    (31.0, 9.2, -0.8, 5.3, 2.0, 2.0, -1.57),
    (5.5, -12.3, -1.0, 4.2, 1.8, 1.5, -1.55),
]
OTHER = [  # the same objects but for the last one, seen from 20 m ahead and 6 m to the left, looking left
    (-2.6, 7.9, -1.0, 4.4, 1.9, 1.5, -1.55),
    (-9.5, -5.2, -1.0, 4.4, 1.8, 1.5, 1.55),
    (1.2, 28.2, -0.4, 9.0, 2.5, 3.2, -1.57),
    (8.9, 1.4, -1.0, 4.6, 1.9, 1.5, 0.02),
    (3.1, -11.1, -0.8, 5.4, 2.0, 2.0, 3.13),
    (-30.0, 4.0, -1.0, 4.5, 1.8, 1.5, 0.90),
]


def boxes(rows: Sequence[tuple[float, ...]]) -> Boxes:
    return Boxes(center=[row[:3] for row in rows], size=[row[3:6] for row in rows], yaw=[row[6] for row in rows])


def main() -> None:
    alignment = BEVGlue().align(boxes(EGO), boxes(OTHER))
    if alignment.ego_SE2_other is None:
        print("refused:", alignment.reason)
    else:
        print(alignment.ego_SE2_other, "from", len(alignment.matches), "common objects")


if __name__ == "__main__":
    main()
