"""Playback: real time, end, and seeking."""

import pytest

from tactip_twin.sim.view.playback import Playback


def test_playback_runs_in_real_time_and_stops_at_the_end():
    replay = Playback(30, rate=10.0)
    assert replay.tick(5.0) == 0  # paused
    replay.toggle()
    assert [replay.tick(5.0 + t) for t in (0.0, 0.1, 0.55, 1.0)] == [0, 1, 5, 10]
    replay.speed = 4.0
    assert replay.tick(6.25) == 20
    assert replay.tick(9.0) == 29 and not replay.playing
    replay.toggle()  # from the start
    assert replay.playing and replay.step == 0


def test_pause_skips_no_steps():
    replay = Playback(100, rate=10.0)
    replay.toggle()
    replay.tick(0.0)
    replay.tick(1.0)
    replay.toggle()
    replay.tick(50.0)
    replay.toggle()
    assert replay.tick(50.5) == 15


def test_backward_clock_is_harmless():
    replay = Playback(100)
    replay.toggle()
    replay.tick(10.0)
    replay.tick(11.0)
    assert replay.tick(3.0) == 10


@pytest.mark.parametrize(("asked", "shown"), [(7, 7), (-3, 0), (99, 9), (3.7, 3)])
def test_playback_seeks(asked, shown):
    replay = Playback(10)
    replay.go(asked)
    assert replay.step == shown


def test_single_steps_pause():
    replay = Playback(10)
    replay.toggle()
    replay.forward(1)
    assert (replay.step, replay.playing) == (1, False)
    replay.forward(-5)
    assert replay.step == 0


def test_events_are_jumped_to():
    replay = Playback(50, events=[30, 10, 10, 70])
    seen = []
    for sense in (1, 1, 1, 1, -1, -1, -1):
        replay.jump(sense)
        seen.append(replay.step)
    assert seen == [10, 30, 49, 49, 30, 10, 10]


def test_playback_of_one_step():
    replay = Playback(1)
    replay.toggle()
    replay.tick(0.0)
    assert replay.tick(1.0) == 0 and not replay.playing
