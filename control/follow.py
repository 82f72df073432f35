"""Following a surface or an edge by touch: make contact, keep the reference, move along a route, and recover from failures.

The follower knows the arm's measured pose and what its estimator returns. The force limit belongs to the arm: it is a
protective stop, as robots have.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tactip_twin.control.estimator import Estimate, Estimator
from tactip_twin.control.options import Settings
from tactip_twin.control.routes import Route
from tactip_twin.control.servo import Controller, pose_error
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import TipOnArm
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Event:
    """An unplanned event."""

    step: int
    """Number of steps recorded before the event."""
    kind: str
    """contact lost, estimate out of range, force, collision, diverged, unreachable."""
    what: str
    """Description, with values."""


@dataclass(frozen=True)
class Step:
    """One recorded control step."""

    phase: str
    """search, centre or follow."""
    part: int
    """Part of the route (routes.Route.part)."""
    T_base_tcp: np.ndarray
    """(4, 4), the sensor's true pose."""
    T_base_tcp_measured: np.ndarray
    """(4, 4), the sensor's pose as measured by the joints."""
    angles: np.ndarray
    """(6,) rad."""
    touch: TipState
    """State of the tip."""
    estimate: Estimate
    """Estimate for that state, fused with earlier ones if there is a filter."""
    label_from_image: np.ndarray
    """(6,), m and rad: the label estimated from this step's image alone."""
    seconds: dict[str, float]
    """Time for simulation, image, network and control, s."""


_SLOW_DEG = {"surface": 2.0, "edge": 0.0}
"""Default of Settings.slowdown_angle_deg by task."""

_MIN_STEP_FRACTION = 0.2
"""Smallest fraction of the tangential step, - [?]."""

_RECOVERED_STEPS = 3
"""Good steps after which the count of recoveries restarts at zero."""


class ContourFollower:
    """Follows one route."""

    def __init__(
        self,
        mounted_tip: TipOnArm,
        estimator: Estimator,
        controller: Controller,
        labels: Labels,
        settings: Settings,
        record: Callable[[Step], None],
        clock: Callable[[], float],
        note: Callable[[Event], None] = lambda event: None,
        pose_filter: PoseFilter | None = None,
    ) -> None:
        """Prepare to follow.

        Args:
            mounted_tip: Tip, arm and object.
            estimator: Estimator of the label.
            controller: Controller of the sensor's pose.
            labels: Components of the label, with the ranges in which estimates are trusted.
            settings: Limits and steps.
            record: Called with each step.
            clock: Returns the time, s.
            note: Called with each event.
            pose_filter: Filter of estimates that have deviations; None: each step uses its own image alone.
        """
        self._mounted_tip, self._estimator, self._controller = mounted_tip, estimator, controller
        self._labels, self._settings = labels, settings
        self._record, self._clock, self._on_event, self._filter = record, clock, note, pose_filter
        self._phase, self._part, self._steps = "search", 0, 0
        self.events: list[Event] = []
        """Events so far."""
        self.stopped_because = ""
        """Reason why the run ended; empty until then."""

    def run(self, T_start: np.ndarray, route: Route) -> None:
        """Make contact and follow a route to its end; `stopped_because` then has the reason.

        Args:
            T_start: (4, 4), a pose at which the tip does not touch the object.
            route: The route.

        Raises:
            TactipError: The start is inside the object.
        """
        try:
            self._mounted_tip.reset_to(T_start, route.wrist_rad)
        except Unreachable as error:
            self.stopped_because = f"the start is out of reach: {error}"
            return
        try:
            self._follow(route)
        except FollowingFailed as reason:
            self.stopped_because = str(reason)

    def _follow(self, route: Route) -> None:
        estimate, centred, good, failures = self._search(self._settings.search_mm), 0, 0, 0
        while self._steps < self._settings.max_steps:
            measured = self._mounted_tip.arm_model.measured_pose()
            failure = self._failure(estimate)
            if failure:
                failures, good = failures + 1, 0
                self._note(*failure)
                if failures > self._settings.max_recoveries:
                    raise FollowingFailed(f"{failure[0]} {failures} times in a row: {failure[1]}")
                estimate, centred = self._recover_from(failure[0]), 0
                continue
            good += 1
            failures = 0 if good >= _RECOVERED_STEPS else failures
            start = self._clock()
            along = np.zeros(3)
            if centred < self._settings.alignment_steps:
                self._phase, centred = "centre", centred + 1
            else:
                self._phase = "follow"
                direction = route.direction(measured, measured @ inverse(sensor_in_contact(estimate.label)))
                self._part = route.part
                if direction is None:
                    self.stopped_because = route.ended
                    return
                along = measured[:3, :3].T @ (self._step_fraction(estimate) * self._settings.step_mm / 1e3 * direction)
            T = measured @ self._controller.move(estimate.label, along)
            estimate = self._go(T, self._clock() - start)
        self.stopped_because = f"reached the limit of {self._settings.max_steps} steps"

    def _step_fraction(self, estimate: Estimate) -> float:
        """Return the fraction of the tangential step to take: smaller where the sensor tilts, because it lags behind the
        surface."""
        slow = (
            _SLOW_DEG[self._labels.task] if self._settings.slowdown_angle_deg is None else self._settings.slowdown_angle_deg
        )
        tilt = np.degrees(np.linalg.norm(pose_error(estimate.label, np.zeros(6))[3:5]))
        return max(_MIN_STEP_FRACTION, 1 - tilt / slow) if slow else 1.0

    def _failure(self, estimate: Estimate) -> tuple[str, str] | None:
        """Return kind and description of a failure, or None."""
        danger, s = self._danger(), self._settings
        if danger:
            return danger
        if estimate.touching < s.contact_threshold:
            difference = f"differs from that of an undeformed tip by {estimate.touching:.2f}"
            return "contact lost", f"the image {difference} (in contact: at least {s.contact_threshold:g})"
        low, high = np.array(self._labels.low), np.array(self._labels.high)
        predicted = to_mm_deg(estimate.label)[[COMPONENTS.index(c) for c in self._labels.components]]
        out = np.maximum(low - predicted, predicted - high) / ((high - low) / 2)
        worst = int(out.argmax())
        if not np.isfinite(predicted).all() or out[worst] > s.range_margin:
            unit = self._labels.units[worst]
            return (
                "estimate out of range",
                f"{self._labels.names[worst]} predicted as {predicted[worst]:.1f} {unit} "
                f"(training range: {low[worst]:g} to {high[worst]:g})",
            )
        return None

    def _danger(self) -> tuple[str, str] | None:
        """Return kind and description of a failure that could cause damage, whatever the estimate, or None."""
        force, limit = float(np.linalg.norm(self._touch.force)), self._settings.max_force_n
        if force > limit:
            return "force", f"{force:.1f} N on the tip (at most {limit:g} N)"
        if self._touch.clearance_m < 0:
            return "collision", f"the sensor's housing overlaps the object by {-1e3 * self._touch.clearance_m:.1f} mm"
        return None

    def _recover_from(self, kind: str) -> Estimate:
        """Search for contact; unless contact was lost, retract first. Return the new estimate."""
        self._phase = "search"
        self._controller.reset()
        if self._filter is not None:
            self._filter.reset()
        if kind != "contact lost":
            self._go(self._mounted_tip.arm_model.measured_pose() @ _shift(-self._settings.retract_mm))
        return self._search(self._settings.search_mm / 2)

    def _search(self, max_mm: float) -> Estimate:
        """Move along the sensor's axis until contact is detected. Return the estimate there.

        Raises:
            FollowingFailed: There is no contact within `max_mm`, or a high force or a collision shows that it was missed.
        """
        s, self._phase = self._settings, "search"
        estimate = self._estimate(0.0)
        travelled_mm = 0.0
        while estimate.touching < s.contact_threshold:
            danger = self._danger()
            if danger:
                self._note(*danger)
                raise FollowingFailed(f"no contact detected in the image, but {danger[0]}: {danger[1]}")
            if travelled_mm >= max_mm:
                raise FollowingFailed(f"no contact detected within {max_mm:g} mm")
            estimate = self._go(self._mounted_tip.arm_model.measured_pose() @ _shift(s.search_step_mm))
            travelled_mm += s.search_step_mm
        return estimate

    def _go(self, T: np.ndarray, control_s: float = 0.0) -> Estimate:
        """Move to a pose (4, 4) and estimate there. Raises FollowingFailed if that is impossible."""
        start = self._clock()
        try:
            self._touch = self._mounted_tip.go(T)
        except Unreachable as error:
            self._note("unreachable", str(error))
            raise FollowingFailed(str(error)) from error
        except Diverged as error:
            self._note("diverged", str(error))
            self._restart()
        return self._estimate(self._clock() - start, control_s)

    def _restart(self) -> None:
        """Restart with an undeformed tip, retracted from the pose at which the simulation diverged."""
        self._phase = "search"
        diverged = self._note_count("diverged")
        if diverged > self._settings.max_recoveries:
            raise FollowingFailed(f"the simulation diverged {diverged} times")
        T = self._mounted_tip.arm_model.measured_pose() @ _shift(-3 * self._settings.retract_mm)
        try:
            self._mounted_tip.reset_to(T, float(np.nan_to_num(self._mounted_tip.arm_model.angles[5])))
        except TactipError as error:
            raise FollowingFailed(f"the simulation diverged and cannot restart from the retracted pose: {error}") from error
        self._touch = self._mounted_tip.tip_state()

    def _estimate(self, simulation_s: float, control_s: float = 0.0) -> Estimate:
        """Estimate the label now, and record the step."""
        if not self._steps:
            self._touch = self._mounted_tip.tip_state()
        arm = self._mounted_tip.arm_model
        own = self._estimator.estimate(self._touch, arm.pose)
        estimate = self._filtered(own, arm.measured_pose())
        seconds = {
            "simulation": simulation_s,
            "image": estimate.image_s,
            "network": estimate.network_s,
            "control": control_s,
        }
        self._record(
            Step(
                self._phase,
                self._part,
                arm.pose,
                arm.measured_pose(),
                arm.angles,
                self._touch,
                estimate,
                own.label,
                seconds,
            )
        )
        self._steps += 1
        return estimate

    def _filtered(self, estimate: Estimate, T_base_tcp_measured: np.ndarray) -> Estimate:
        """Return an estimate fused with those before it; as it is without a filter, without deviations or in the air."""
        if self._filter is None or estimate.deviations is None:
            return estimate
        if estimate.touching < self._settings.contact_threshold:
            self._filter.reset()
            return estimate
        fused = self._filter.step(T_base_tcp_measured, estimate.label, estimate.deviations)
        return replace(estimate, label=fused.label, deviations=fused.deviations)

    def _note(self, kind: str, what: str) -> None:
        self.events.append(Event(self._steps, kind, what))
        self._on_event(self.events[-1])

    def _note_count(self, kind: str) -> int:
        return sum(e.kind == kind for e in self.events)


class FollowingFailed(Exception):
    """A route cannot be followed further; the message says why."""


def _shift(forward_mm: float) -> np.ndarray:
    """Return the motion (4, 4) along the sensor's axis."""
    T = np.eye(4)
    T[2, 3] = from_mm_deg([forward_mm, 0, 0, 0, 0, 0])[0]
    return T
