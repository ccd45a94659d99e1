"""Orders of layouts: from the usual values outwards, each combination once."""

from __future__ import annotations

import pytest

from lightsim.scenario.layouts import Choice, layouts, outwards, sides


def test_values_spread_from_the_usual_one_within_bounds() -> None:
    tried = layouts({"gap_m": outwards(None, 10.0, (6.0, 20.0), 2.0)})
    assert [t.values["gap_m"] for t in tried] == [10, 8, 12, 6, 14, 16, 18, 20]
    assert [t.options for t in tried[:2]] == ["--gap-m 10", "--gap-m 8"]


def test_the_other_side_comes_after_near_places_and_before_far_ones() -> None:
    choices = {
        "ahead_m": outwards(None, 8.0, (8.0, 20.0), 4.0),
        "from_left": sides(False, False, usually_left=False),
    }
    tried = layouts(choices)
    assert [tuple(t.values.values()) for t in tried] == [
        (8.0, False), (12.0, False), (8.0, True), (16.0, False),
        (12.0, True), (20.0, False), (16.0, True), (20.0, True),
    ]  # fmt: skip
    assert tried[2].options == "--ahead-m 8 --from-left"
    assert tried[0].options == "--ahead-m 8 --from-right"


@pytest.mark.parametrize(("left", "right"), [(True, False), (False, True)])
def test_what_the_user_gave_is_not_varied(left: bool, right: bool) -> None:
    choices = {
        "gap_m": outwards(7.5, 10.0, (6.0, 20.0), 1.0),
        "from_left": sides(left, right, usually_left=True),
        "is_next_lane": [Choice(False), Choice(True, 1.0)],
    }
    tried = layouts(choices)
    assert [t.values for t in tried] == [
        {"gap_m": 7.5, "from_left": left, "is_next_lane": value} for value in (False, True)
    ]
    assert [t.options for t in tried] == ["", "--next-lane"]
