"""Following a surface or an edge by touch: make contact, keep the reference, go along a route; and what to do when it goes
wrong.

The explorer knows the arm's joint angles and what its estimator sees. That it may not know the truth is seen to by what it
is given. The force at which it stops is the arm's: a protective stop, as robots have.
"""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Event:
    """Something that was not planned, and what was done about it."""

    step: int
    """Steps that were recorded before it."""
    kind: str
    """contact lost, estimate out of range, force, collision, diverged, unreachable."""
    what: str
    """A sentence."""


@dataclass(frozen=True)
class Step:
    """One control step, as it is recorded."""

    phase: str
    """search, centre or follow."""
    part: int
    """Of the route."""
    T_base_tcp: np.ndarray
    """(4, 4), where the sensor truly is."""
    T_told: np.ndarray
    """(4, 4), where its joints say it is."""
    angles: np.ndarray
    """(6,) rad."""
    touch: object
    """tactip_twin.sim.contact.tip_state.TipState."""
    sight: object
    """estimator.Estimate."""
    seconds: dict
    """Time for simulation, image, network and control, s."""


_SLOW_DEG = {"surface": 2.0, "edge": 0.0}
"""Settings.slow_deg where it is not given, by task."""

_LEAST_PACE = 0.2
"""Least share of the tangential step, -: an estimate."""

_GOOD = 3
"""Good steps after which troubles are forgotten."""


class ContourFollower:
    """Follows one route."""

    def __init__(self, finger, estimator, servo, labels, settings, record, clock, note=lambda event: None):
        """finger: MountedTip. estimator: Estimator. servo: Servo. labels: learning.labels.Labels, with the ranges that were
        learned. settings: Settings. record: called with each Step. clock: function that tells s. note: called with each
        Event."""
        self._finger, self._estimator, self._servo = finger, estimator, servo
        self._labels, self._settings = labels, settings
        self._record, self._clock, self._tell = record, clock, note
        self._phase, self._part, self._steps = "search", 0, 0
        self.events = []
        """Events so far."""
        self.stopped_because = ""
        """Why it came to its end."""

    def run(self, T_start, route):
        """Make contact from a pose (4, 4) off the object, and follow a Route to its end.

        Returns nothing: what came of it is recorded; `stopped_because` says how it ended. Raises what is no matter of
        control: TactipError where the start is in the object.
        """
        try:
            self._finger.put(T_start, route.wrist_rad)
        except Unreachable as error:
            self.stopped_because = f"the start is out of reach: {error}"
            return
        try:
            self._follow(route)
        except _GivesUp as reason:
            self.stopped_because = str(reason)

    def _follow(self, route):
        sight, centred, good, trouble = self._search(self._settings.search_mm), 0, 0, 0
        while self._steps < self._settings.most_steps:
            told = self._finger.carrier.told()
            fault = self._fault(sight)
            if fault:
                trouble, good = trouble + 1, 0
                self._note(*fault)
                if trouble > self._settings.most_trouble:
                    raise _GivesUp(f"{fault[0]} again and again: {fault[1]}")
                sight, centred = self._react(fault[0]), 0
                continue
            good += 1
            trouble = 0 if good >= _GOOD else trouble
            start = self._clock()
            along = np.zeros(3)
            if centred < self._settings.centre_steps:
                self._phase, centred = "centre", centred + 1
            else:
                self._phase = "follow"
                way = route.along(told, told @ inverse(sensor_in_contact(sight.label)))
                self._part = route.part
                if way is None:
                    self.stopped_because = route.ended
                    return
                along = told[:3, :3].T @ (self._pace(sight) * self._settings.step_mm / 1e3 * way)
            T = told @ self._servo.move(sight.label, along)
            sight = self._go(T, self._clock() - start)
        self.stopped_because = f"it took {self._settings.most_steps} steps, as many as it may"

    def _pace(self, sight):
        """Share of the tangential step that is taken: less where the sensor leans, which follows the surface's turns with a
        lag."""
        slow = _SLOW_DEG[self._labels.task] if self._settings.slow_deg is None else self._settings.slow_deg
        lean = np.degrees(np.linalg.norm(self._servo.error(sight.label)[3:5]))
        return max(_LEAST_PACE, 1 - lean / slow) if slow else 1.0

    def _fault(self, sight):
        """Kind and sentence of what is wrong, or None."""
        danger, s = self._danger(), self._settings
        if danger:
            return danger
        if sight.touching < s.touch:
            return "contact lost", f"the image is that of a tip in the air, to {sight.touching:.2f}"
        low, high = np.array(self._labels.low), np.array(self._labels.high)
        told = to_mm_deg(sight.label)[[COMPONENTS.index(c) for c in self._labels.components]]
        out = np.maximum(low - told, told - high) / ((high - low) / 2)
        worst = int(out.argmax())
        if not np.isfinite(told).all() or out[worst] > s.beyond:
            unit = self._labels.units[worst]
            return (
                "estimate out of range",
                f"{self._labels.names[worst]} is felt as {told[worst]:.1f} {unit} "
                f"(learned: {low[worst]:g} to {high[worst]:g})",
            )
        return None

    def _danger(self):
        """Kind and sentence of what would do harm, whatever is felt, or None."""
        force, most = float(np.linalg.norm(self._touch.force)), self._settings.most_force_n
        if force > most:
            return "force", f"{force:.1f} N on the tip (at most {most:g} N)"
        if self._touch.clearance_m < 0:
            return "collision", f"the sensor's housing runs against the object, {-1e3 * self._touch.clearance_m:.1f} mm"
        return None

    def _react(self, kind):
        """What is done about a fault: look for contact where it is lost, else back off and look again. Returns a
        Estimate."""
        self._phase = "search"
        self._servo.forget()
        if kind != "contact lost":
            self._go(self._finger.carrier.told() @ _shift(-self._settings.back_off_mm))
        return self._search(self._settings.search_mm / 2)

    def _search(self, most_mm):
        """Go along the sensor's axis until something is felt. Returns its Estimate. Raises _GivesUp where nothing is, or
        where the force or the housing says that it should have been."""
        s, self._phase = self._settings, "search"
        sight = self._look(0.0)
        gone = 0.0
        while sight.touching < s.touch:
            danger = self._danger()
            if danger:
                self._note(*danger)
                raise _GivesUp(f"nothing is felt, and yet there is {danger[0]}: {danger[1]}")
            if gone >= most_mm:
                raise _GivesUp(f"nothing is felt within {most_mm:g} mm")
            sight = self._go(self._finger.carrier.told() @ _shift(s.search_step_mm))
            gone += s.search_step_mm
        return sight

    def _go(self, T, control_s=0.0):
        """Go to a pose (4, 4) and look. Raises _GivesUp where that is out of reach, and where the tip is lost for good."""
        start = self._clock()
        try:
            self._touch = self._finger.go(T)
        except Unreachable as error:
            self._note("unreachable", str(error))
            raise _GivesUp(str(error)) from error
        except Diverged as error:
            self._note("diverged", str(error))
            self._recover()
        return self._look(self._clock() - start, control_s)

    def _recover(self):
        """After the simulation lost the tip: an undeformed one, clear of the object, at the back of where it was."""
        self._phase = "search"
        lost = self._note_count("diverged")
        if lost > self._settings.most_trouble:
            raise _GivesUp(f"the simulation lost the tip {lost} times")
        T = self._finger.carrier.told() @ _shift(-3 * self._settings.back_off_mm)
        try:
            self._finger.put(T, float(np.nan_to_num(self._finger.carrier.angles[5])))
        except TactipError as error:
            raise _GivesUp(f"the simulation lost the tip, and there is no room to begin again: {error}") from error
        self._touch = self._finger.touch()

    def _look(self, simulation_s, control_s=0.0):
        """See what is touched now, and record the step."""
        if not self._steps:
            self._touch = self._finger.touch()
        carrier = self._finger.carrier
        sight = self._estimator.look(self._touch, carrier.pose)
        seconds = {
            "simulation": simulation_s,
            "image": sight.image_s,
            "network": sight.network_s,
            "control": control_s,
        }
        self._record(
            Step(self._phase, self._part, carrier.pose, carrier.told(), carrier.angles, self._touch, sight, seconds)
        )
        self._steps += 1
        return sight

    def _note(self, kind, what):
        self.events.append(Event(self._steps, kind, what))
        self._tell(self.events[-1])

    def _note_count(self, kind):
        return sum(e.kind == kind for e in self.events)


class _GivesUp(Exception):
    """The end of a route before its end."""


def _shift(forward_mm):
    """The motion (4, 4) along the sensor's axis."""
    T = np.eye(4)
    T[2, 3] = from_mm_deg([forward_mm, 0, 0, 0, 0, 0])[0]
    return T
