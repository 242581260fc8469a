"""Line of sight in the plane, on scenes that can be checked by eye. The sensor is at the origin."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.simulation.visibility import is_visible, visible_fraction


def boxes(*rows: tuple[float, float, float, float, float]) -> Boxes:
    """Boxes of x, y, length, width, yaw."""
    table = np.array(rows).reshape(-1, 5)
    return Boxes(
        center=np.column_stack([table[:, :2], np.zeros(len(table))]),
        size=np.column_stack([table[:, 2:4], np.ones(len(table))]),
        yaw=table[:, 4],
    )


@pytest.mark.parametrize(
    ("rows", "expected", "why"),
    [
        ([(10, 0, 2, 2, 0)], [1.0], "one box alone is seen whole"),
        ([(10, 0, 2, 2, 0), (20, 0, 2, 2, 0)], [1.0, 0.0], "one of the same size right behind it is hidden"),
        ([(20, 0, 2, 2, 0), (10, 0, 2, 2, 0)], [0.0, 1.0], "in whatever order they come"),
        ([(10, 0, 2, 2, 0), (0, 20, 2, 2, 0)], [1.0, 1.0], "one in another direction is not"),
        ([(10, 0, 2, 2, 0), (-20, 0, 2, 2, 0)], [1.0, 1.0], "nor one on the other side of the sensor"),
        ([(10, 0, 2, 2, 0), (20, 0, 2, 40, 0)], [1.0, 7 / 9], "a wall behind it looks out on both sides"),
        ([(10, 5, 2, 10, 0), (21, 0, 2, 4, 0)], [1.0, 4 / 9], "half of it is hidden by a wall that ends at the middle"),
        ([(-10, 0, 2, 2, 0), (-20, 0, 2, 2, 0)], [1.0, 0.0], "bearings around +-180 degrees are no exception"),
        ([(10, 0, 0.1, 8, np.pi / 2), (20, 0, 2, 2, 0)], [1.0, 7 / 9], "a thin one seen from its end hides little"),
        ([], [], "no boxes"),
    ],
)
def test_what_is_not_covered_by_another_box(rows: list[tuple[float, ...]], expected: list[float], why: str) -> None:
    fractions = visible_fraction(boxes(*rows))  # type: ignore[arg-type]
    np.testing.assert_allclose(fractions, expected, atol=0.12, err_msg=why)  # nine rays: one may go either way


def test_range_counts_from_the_origin_to_the_centre() -> None:
    seen = is_visible(boxes((30, 0, 4, 2, 0), (0, 50.1, 4, 2, 0), (-30, -39.9, 4, 2, 0)), 50.0, 0.5)
    assert seen.tolist() == [True, False, True]


def test_what_counts_as_hidden_can_be_chosen() -> None:
    scene = boxes((10, 5, 2, 10, 0), (21, 0, 2, 4, 0))
    assert is_visible(scene, 50.0, 0.3).tolist() == [True, True]
    assert is_visible(scene, 50.0, 0.8).tolist() == [True, False]


@given(
    st.lists(
        st.tuples(st.floats(5, 60), st.floats(-60, 60), st.floats(1, 12), st.floats(1, 3), st.floats(-3, 3)),
        min_size=1,
        max_size=8,
    )
)
def test_company_never_makes_a_box_more_visible(
    rows: list[tuple[float, float, float, float, float]],
) -> None:
    fractions = visible_fraction(boxes(*rows))
    assert fractions.max() > 0
    fewer = visible_fraction(boxes(*rows[:-1]))
    assert (fractions[:-1] <= fewer + 1e-12).all()


@pytest.mark.parametrize(
    ("sensor_height", "hiding_height", "seen", "why"),
    [
        (6.0, 1.5, [1.0, 1.0], "a mast looks over a car at the roof of the next one"),
        (6.0, 4.0, [1.0, 0.0], "not over a truck that is right before it"),
        (1.9, 2.5, [1.0, 0.0], "a roof of a car does not look over a van"),
        (40.0, 4.0, [1.0, 1.0], "from high enough every roof is seen"),
    ],
)
def test_sensor_looks_over_low_boxes(sensor_height: float, hiding_height: float, seen: list[float], why: str) -> None:
    scene = boxes((14, 0, 5, 2, 0), (20, 0, 4, 1.8, 0))
    height = np.array([hiding_height, 1.5])
    scene = scene.replace(
        center=np.column_stack([scene.center[:, :2], height / 2 - sensor_height]),
        size=np.column_stack([scene.size[:, :2], height]),
    )
    np.testing.assert_allclose(visible_fraction(scene, over_tops=True), seen, err_msg=why)
    np.testing.assert_allclose(visible_fraction(scene), [1.0, 0.0], err_msg="footprints alone hide it")
