"""Placement of labels: they do not overlap if there is enough space."""

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.plot_layout import LabelBox, place_labels, stack_labels

BOUNDS = LabelBox(0.0, 0.0, 240.0, 180.0)
INSIDE = st.tuples(st.floats(0, 240), st.floats(0, 180))
SIZES = st.tuples(st.floats(20, 60), st.floats(8, 18))


@given(st.lists(st.tuples(INSIDE, SIZES), min_size=1, max_size=8))
def test_stacked_labels_do_not_overlap_and_keep_the_order_of_their_points(
    labels: list[tuple[tuple[float, float], tuple[float, float]]],
) -> None:
    anchors, sizes = zip(*labels, strict=True)
    boxes = stack_labels(anchors, sizes, 180.0, BOUNDS)
    assert all(box.left == 180.0 for box in boxes)
    for first, second in combinations(range(len(boxes)), 2):
        assert boxes[first].overlap(boxes[second]) < 1e-6
        if anchors[first][1] < anchors[second][1]:
            assert boxes[first].bottom <= boxes[second].bottom
    assert min(box.bottom for box in boxes) >= -1e-6
    assert max(box.bottom + box.height for box in boxes) <= 180.0 + 1e-6


@given(st.lists(INSIDE, min_size=1, max_size=4))
def test_a_few_labels_overlap_nothing_and_are_within_the_bounds(points: list[tuple[float, float]]) -> None:
    marks = [LabelBox(x - 3, y - 3, 6, 6) for x, y in points]
    placements = place_labels([[point] for point in points], [(40.0, 9.0)] * len(points), BOUNDS, marks)
    boxes = [box for _, box in placements]
    for first, second in combinations(boxes, 2):
        assert first.overlap(second) == 0
    for box in boxes:
        assert box.overlap(BOUNDS) > 0.99 * box.area
        assert all(box.overlap(mark) == 0 for mark in marks)


def test_a_label_is_placed_at_the_point_of_its_curve_that_has_space() -> None:
    obstacles = [LabelBox(0.0, 0.0, 120.0, 180.0)]
    ((point, box),) = place_labels([[(20.0, 90.0), (180.0, 90.0)]], [(40.0, 9.0)], BOUNDS, obstacles)
    assert point == (180.0, 90.0)
    assert box.gap(point) < 9.0
    assert box.overlap(obstacles[0]) == 0
