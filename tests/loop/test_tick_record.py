import math

from fitctl.logging.records import Tick


def test_a_tick_without_a_frame_has_none_of_its_numbers(vernier, monkeypatch):
    vernier.records.clear()
    monkeypatch.setattr(vernier.supervisor._camera, "ready", False)  # nothing comes from it
    vernier.run(0.1)

    ticks = [record for record in vernier.records if isinstance(record, Tick)]
    assert {(tick.number, tick.late, tick.star_visible) for tick in ticks} == {(-1, False, False)}
    assert all(math.isnan(tick.frame_age_s) for tick in ticks)
