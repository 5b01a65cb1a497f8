"""Places of labels: none covers another where there is room, whatever is drawn."""

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.label_placement import LabelBox, placed, stacked

ROOM = LabelBox(0.0, 0.0, 240.0, 180.0)
INSIDE = st.tuples(st.floats(0, 240), st.floats(0, 180))
SIZES = st.tuples(st.floats(20, 60), st.floats(8, 18))


@given(st.lists(st.tuples(INSIDE, SIZES), min_size=1, max_size=8))
def test_stacked_labels_are_apart_and_in_the_order_of_their_points(
    labels: list[tuple[tuple[float, float], tuple[float, float]]],
) -> None:
    at, sizes = zip(*labels, strict=True)
    boxes = stacked(at, sizes, 180.0, ROOM)
    assert all(box.left == 180.0 for box in boxes)
    for one, other in combinations(range(len(boxes)), 2):
        assert boxes[one].overlap(boxes[other]) < 1e-6
        if at[one][1] < at[other][1]:
            assert boxes[one].bottom <= boxes[other].bottom
    assert min(box.bottom for box in boxes) >= -1e-6
    assert max(box.bottom + box.height for box in boxes) <= 180.0 + 1e-6


@given(st.lists(INSIDE, min_size=1, max_size=4))
def test_few_labels_cover_nothing_and_are_inside(points: list[tuple[float, float]]) -> None:
    marks = [LabelBox(x - 3, y - 3, 6, 6) for x, y in points]
    found = placed([[point] for point in points], [(40.0, 9.0)] * len(points), ROOM, marks)
    boxes = [box for _, box in found]
    for one, other in combinations(boxes, 2):
        assert one.overlap(other) == 0
    for box in boxes:
        assert box.overlap(ROOM) > 0.99 * box.area
        assert all(box.overlap(mark) == 0 for mark in marks)


def test_a_label_takes_the_point_of_its_curve_beside_which_there_is_room() -> None:
    crowded = [LabelBox(0.0, 0.0, 120.0, 180.0)]
    ((point, box),) = placed([[(20.0, 90.0), (180.0, 90.0)]], [(40.0, 9.0)], ROOM, crowded)
    assert point == (180.0, 90.0)
    assert box.gap(point) < 9.0
    assert box.overlap(crowded[0]) == 0
