"""Following a surface or an edge by touch: make contact, keep the reference, move along a route, and get past obstacles.

At a failure the tip seeks contact again on the spot. If it fails again, it lifts off and touches down farther along the
route (obstacles.py); the stretch between is left out and reported. A run ends at the end of its route. The follower knows
the arm's measured pose and what its estimator returns. The force limit belongs to the arm: it is a protective stop, as
robots have.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.control.estimator import Estimate, Estimator
from tactip_twin.control.obstacles import LeftOut, Obstacle, Tries
from tactip_twin.control.options import Settings
from tactip_twin.control.press import press_room_m
from tactip_twin.control.routes import Route
from tactip_twin.control.sensor_poses import moved, tilt_rad, tilted_at_most
from tactip_twin.control.servo import Controller, pose_error
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, interpolate, inverse, matrix, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import TipOnArm, clear_pose
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Event:
    """An unplanned event."""

    step: int
    """Number of steps recorded before the event."""
    kind: str
    """contact lost, no contact, estimate out of range, force, collision, no progress, too steep, diverged, unreachable."""
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

_EVASION_MM = 1.0
"""Motion back along the sensor's axis after a stop of the arm at its limit of force or a collision, mm [?]."""

_UPRIGHT_RAD, _UPRIGHT_M = np.radians(5.0), 6e-3
"""Angle by which the sensor turns closer to the route's direction of approach after a collision, rad, and the travel along
the route over which it does not tilt farther, m [?]."""

_MAX_APPROACH_RAD = np.radians(60.0)
"""Largest tilt from the route's direction of approach with which the sensor touches down, rad: leaning farther, it passes
the object or touches it with its housing first [?]."""

_ALIGNED_DEG = 3.0
"""Estimated angle to the normal from which the tip counts as aligned, degrees [?]."""

_MIN_STEP_FRACTION = 0.2
"""Smallest fraction of the tangential step, - [?]."""

_MAX_MOTION_M, _MAX_TURN_RAD = 2e-3, np.radians(4.0)
"""Longest motion and largest turn of a control step, m and rad: a turn about the apex moves the tip's flanks [?]."""

_TRANSIT_M = 10e-3
"""Longest motion through the air between two checks of force and clearance, m."""

_BACK_STEPS, _MAX_TRAIL = 5, 50
"""Number of steps that the tip goes back before the arm tries again to lift it, and their maximum."""

_FREE = 0.1
"""Fraction of Settings.contact_threshold below which the tip counts as free, -."""

_MAX_DIVERGED = 20
"""Number of divergences of the simulation after which a run ends."""

_LEFT_OUT_M = 2e-3
"""Spacing of the recorded places of a stretch that was left out, m."""


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
        self._followed_to_m, self._centred = 0.0, 0
        self._max_tilt_rad, self._upright_to_m = np.pi, 0.0
        self.left_out: list[LeftOut] = []
        """Stretches of the route that were not followed."""
        self.events: list[Event] = []
        """Events so far."""
        self.peak_force_n = 0.0
        """Maximum force on the tip so far, also within a step, N."""
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
        self._T_free = self._T_good = T_start
        self._wrist_rad, self._highest = route.wrist_rad, -np.inf
        self._trail: deque[np.ndarray] = deque(maxlen=_MAX_TRAIL)
        self._direction, self._tries = route.approach, Tries(self._settings, route.approach is not None)
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
        estimate: Estimate | None = None
        try:
            estimate = self._search(self._settings.search_mm)
        except Obstacle as obstacle:
            if obstacle.kind == "no contact":
                raise FollowingFailed(str(obstacle)) from obstacle
            estimate = self._get_past(obstacle, route)
        while estimate is not None and self._steps < self._settings.max_steps:
            try:
                estimate = self._step(route, estimate)
            except Obstacle as obstacle:
                estimate = self._get_past(obstacle, route)
        self.stopped_because = route.ended or f"reached the limit of {self._settings.max_steps} steps"

    def _step(self, route: Route, estimate: Estimate) -> Estimate | None:
        """Take a control step, and return the estimate after it; None at the end of the route. Raises Obstacle."""
        aligning = self._is_aligning(estimate)
        failure = self._failure(estimate, aligning)
        if failure:
            if failure[0] not in ("force", "collision") or not self._tries.evades(route.travelled_m):
                raise Obstacle(*failure)
            self._note(*failure)
            return self._evade(failure[0], route)
        measured, start, along = self._mounted_tip.arm_model.measured_pose(), self._clock(), np.zeros(3)
        if aligning:
            self._phase, self._centred = "centre", self._centred + 1
        else:
            self._phase, self._centred = "follow", 2 * self._settings.alignment_steps
            direction = route.direction(measured, measured @ inverse(sensor_in_contact(estimate.label)))
            self._part = route.part
            if direction is None:
                return None
            self._T_good, self._followed_to_m = measured, route.travelled_m
            self._tries.followed(route.travelled_m)
            along = measured[:3, :3].T @ (self._step_fraction(estimate) * self._settings.step_mm / 1e3 * direction)
        room_m = press_room_m(estimate.force_n, self._settings.ease_force_n)
        motion = self._limited(self._controller.move(self._in_range(estimate.label), along, room_m))
        motion[2, 3] = min(motion[2, 3], room_m)
        if route.travelled_m > self._upright_to_m:
            self._max_tilt_rad = np.pi
        return self._go(tilted_at_most(measured @ motion, self._direction, self._max_tilt_rad), self._clock() - start)

    def _evade(self, kind: str, route: Route) -> Estimate:
        """Move back a little after a stop of the arm or a collision; after a collision, also turn closer to the route's
        direction of approach, and stay so for a while."""
        back = moved(self._mounted_tip.arm_model.measured_pose(), None, -_EVASION_MM)
        if kind == "collision" and self._direction is not None:
            tilt = min(self._max_tilt_rad, tilt_rad(back, self._direction))
            self._max_tilt_rad, self._upright_to_m = max(0.0, tilt - _UPRIGHT_RAD), route.travelled_m + _UPRIGHT_M
        return self._go(tilted_at_most(back, self._direction, self._max_tilt_rad))

    def _is_aligning(self, estimate: Estimate) -> bool:
        """Return whether the tip still turns in place after contact: longer where it is far from the normal."""
        steps, upright = self._settings.alignment_steps, self._max_tilt_rad < np.pi
        return self._centred < steps or (self._centred < 2 * steps and _angle_deg(estimate) > _ALIGNED_DEG and not upright)

    def _limited(self, motion: np.ndarray) -> np.ndarray:
        """Return a motion (4, 4) of the sensor, shortened to what is safe in contact."""
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        max_m = max(_MAX_MOTION_M, 1.5e-3 * self._settings.step_mm)
        fraction = 1 / max(1.0, np.linalg.norm(motion[:3, 3]) / max_m, np.linalg.norm(turn) / _MAX_TURN_RAD)
        return matrix(fraction * motion[:3, 3], Rotation.from_rotvec(fraction * turn))

    def _in_range(self, label: np.ndarray) -> np.ndarray:
        """Return a label (6,), m and rad, with the estimated components within the range of the training."""
        rows = [COMPONENTS.index(c) for c in self._labels.components]
        out = to_mm_deg(label)
        out[rows] = np.clip(out[rows], self._labels.low, self._labels.high)
        return from_mm_deg(out)

    def _get_past(self, obstacle: Obstacle, route: Route) -> Estimate | None:
        """Try to continue after an obstacle until there is contact. Return the estimate there; None at the end of the
        route."""
        while self._steps < self._settings.max_steps:
            self._note(obstacle.kind, str(obstacle))
            self._phase, self._centred = "search", 0
            self._controller.reset()
            if self._filter is not None:
                self._filter.reset()
            self._max_tilt_rad = np.pi
            what = self._tries.next(obstacle.kind)
            try:
                if what.skip_mm is None:
                    return self._recover_from(obstacle.kind)
                T = route.skip(what.skip_mm / 1e3, self._T_good)
                self._leave_out(route, T, obstacle.kind)
                if T is None:
                    return None
                self._tries.skipped_to(route.travelled_m)
                return self._approach(tilted_at_most(T, route.approach, 0.0 if what.turned else _MAX_APPROACH_RAD))
            except Obstacle as another:
                obstacle = another
        return None

    def _leave_out(self, route: Route, T: np.ndarray | None, kind: str) -> None:
        """Report that the route was not followed up to a pose T (4, 4), or its end, because of a kind of obstacle."""
        start_m, end_m = self._followed_to_m, route.travelled_m
        if self.left_out and self.left_out[-1].from_mm == 1e3 * start_m:  # a longer skip at the same obstacle
            self.left_out.pop()
        if end_m > start_m:
            distances = np.linspace(start_m, end_m, 2 + int((end_m - start_m) / _LEFT_OUT_M))
            start = self._T_good[:3, 3]
            places = route.places(distances, start, start if T is None else T[:3, 3])
            self.left_out.append(LeftOut(1e3 * start_m, 1e3 * end_m, kind, places.tolist()))

    def _approach(self, T: np.ndarray) -> Estimate:
        """Lift off, move over a place on the route at a pose T (4, 4), and search for contact there. Return the estimate.

        Raises:
            Obstacle: There is no way, or no contact.
        """
        s = self._settings
        self._lift()
        height_mm = self._height_mm(T)
        self._travel(moved(T, self._direction, -height_mm), watched=True)
        return self._search(height_mm + s.clearance_mm, 3 * s.search_step_mm, self._direction)

    def _height_mm(self, T: np.ndarray) -> float:
        """Return the height above a pose (4, 4), mm, at which the tip is clear of what it has touched so far."""
        if self._direction is None:
            return self._settings.clearance_mm
        return self._settings.clearance_mm + 1e3 * max(0.0, self._highest + float(T[:3, 3] @ self._direction))

    def _lift(self) -> None:
        """Lift off. Where the arm cannot, at a limit of its joints, go back until it can; at last, turn to the route's
        direction of approach on the way up. Raises Obstacle."""
        trail = list(self._trail)[::-1]
        for k in range(0, len(trail), _BACK_STEPS):
            try:
                self._pull(moved(self._mounted_tip.arm_model.measured_pose(), None, -self._settings.retract_mm))
                here = self._mounted_tip.arm_model.measured_pose()
                self._travel(moved(here, self._direction, -self._height_mm(here)))
                return
            except Obstacle as obstacle:
                if obstacle.kind != "unreachable":
                    raise
            for pose in trail[k : k + _BACK_STEPS]:
                self._go(pose)
        here = self._mounted_tip.arm_model.measured_pose()
        self._travel(tilted_at_most(moved(here, self._direction, -self._height_mm(here)), self._direction, 0.0))

    def _travel(self, T: np.ndarray, watched: bool = False) -> None:
        """Move to a pose (4, 4) off the object. watched: whether contact on the way is an obstacle. Raises Obstacle."""
        start = self._mounted_tip.arm_model.measured_pose()
        count = max(1, int(np.ceil(np.linalg.norm(T[:3, 3] - start[:3, 3]) / _TRANSIT_M)))
        for k in range(1, count + 1):
            pose = interpolate(start, T, k / count)
            if not watched:
                self._pull(pose)
            else:
                self._go(pose)
                danger = self._danger()
                if danger:
                    raise Obstacle(*danger)

    def _pull(self, T: np.ndarray) -> None:
        """Move to a pose (4, 4) off the object. Where the arm stops at its limit of force, because an undercut holds the
        skin, pull it free: otherwise the tip would stay there for the rest of the run. Raises Obstacle."""
        self._go(T)
        if self._touch.moved_back:
            self._go(T, max_force_n=np.inf)

    def _step_fraction(self, estimate: Estimate) -> float:
        """Return the fraction of the tangential step to take: smaller where the sensor tilts, because it lags behind the
        surface."""
        slow = (
            _SLOW_DEG[self._labels.task] if self._settings.slowdown_angle_deg is None else self._settings.slowdown_angle_deg
        )
        if self._max_tilt_rad < np.pi:  # it leans because of an obstacle
            return 1.0
        return max(_MIN_STEP_FRACTION, 1 - _angle_deg(estimate) / slow) if slow else 1.0

    def _failure(self, estimate: Estimate, aligning: bool) -> tuple[str, str] | None:
        """Return kind and description of a failure, or None. aligning: whether estimates may be out of range, because the
        tip turns in place."""
        danger, s = self._danger(), self._settings
        if danger:
            return danger
        if estimate.touching < s.contact_threshold:
            difference = f"differs from that of an undeformed tip by {estimate.touching:.2f}"
            return "contact lost", f"the image {difference} (in contact: at least {s.contact_threshold:g})"
        predicted, out = self._predicted(estimate.label)
        worst = int(out.argmax())
        if not np.isfinite(predicted).all() or (out[worst] > s.range_margin and not aligning):
            unit = self._labels.units[worst]
            return (
                "estimate out of range",
                f"{self._labels.names[worst]} predicted as {predicted[worst]:.1f} {unit} "
                f"(training range: {self._labels.low[worst]:g} to {self._labels.high[worst]:g})",
            )
        return None

    def _predicted(self, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the components of a label (6,), m and rad, that the network predicts, mm and degrees, and how far they are
        beyond their trained ranges, as fractions of the ranges' half widths; both (k,)."""
        low, high = np.array(self._labels.low), np.array(self._labels.high)
        predicted = to_mm_deg(label)[[COMPONENTS.index(c) for c in self._labels.components]]
        return predicted, np.maximum(low - predicted, predicted - high) / ((high - low) / 2)

    def _danger(self) -> tuple[str, str] | None:
        """Return kind and description of a failure that could cause damage, whatever the estimate, or None."""
        touch, limit = self._touch, self._settings.max_force_n
        force = touch.peak_force_n if touch.moved_back else float(np.linalg.norm(touch.force))
        if force > limit:
            return "force", f"{force:.1f} N on the tip (at most {limit:g} N)"
        if self._touch.clearance_m < 0:
            return "collision", f"the sensor's housing overlaps the object by {-1e3 * self._touch.clearance_m:.1f} mm"
        return None

    def _recover_from(self, kind: str) -> Estimate:
        """Search for contact; unless contact was lost, retract first. Return the new estimate. Raises Obstacle."""
        if kind != "contact lost":
            self._pull(moved(self._mounted_tip.arm_model.measured_pose(), None, -self._settings.retract_mm))
        return self._search(self._settings.search_mm / 2)

    def _search(self, max_mm: float, step_mm: float | None = None, direction: np.ndarray | None = None) -> Estimate:
        """Move until contact is detected. Return the estimate there.

        Args:
            max_mm: Maximum travel.
            step_mm: Length of a step; Settings.search_step_mm if None.
            direction: (3,) unit, base frame; the sensor's axis if None.

        Raises:
            Obstacle: There is no contact within `max_mm`, or a high force or a collision shows that it was missed.
        """
        s = self._settings
        step_mm = step_mm or s.search_step_mm
        estimate = self._estimate(0.0)
        travelled_mm = 0.0
        while estimate.touching < s.contact_threshold:
            danger = self._danger()
            if danger:
                raise Obstacle(danger[0], f"no contact detected in the image, but {danger[1]}")
            if travelled_mm >= max_mm:
                raise Obstacle("no contact", f"no contact detected within {max_mm:g} mm")
            estimate = self._go(moved(self._mounted_tip.arm_model.measured_pose(), direction, step_mm))
            travelled_mm += step_mm
        return estimate

    def _go(self, T: np.ndarray, control_s: float = 0.0, max_force_n: float | None = None) -> Estimate:
        """Move to a pose (4, 4) and estimate there. max_force_n: Force at which the arm stops; that of the settings if None.
        Raises Obstacle if that is impossible."""
        start = self._clock()
        try:
            self._touch = self._mounted_tip.go(T, self._settings.max_force_n if max_force_n is None else max_force_n)
            self.peak_force_n = max(self.peak_force_n, self._touch.peak_force_n)
        except Unreachable as error:
            raise Obstacle("unreachable", str(error)) from error
        except Diverged as error:
            self._restart()
            raise Obstacle("diverged", str(error)) from error
        return self._estimate(self._clock() - start, control_s)

    def _restart(self) -> None:
        """Restart with an undeformed tip, where the tip was last free."""
        if sum(event.kind == "diverged" for event in self.events) >= _MAX_DIVERGED:
            raise FollowingFailed(f"the simulation diverged more than {_MAX_DIVERGED} times")
        try:
            self._mounted_tip.reset_to(clear_pose(self._mounted_tip, self._T_free), self._wrist_rad)
        except TactipError as error:
            raise FollowingFailed(f"the simulation diverged and cannot restart where the tip was free: {error}") from error
        self._touch = self._mounted_tip.tip_state()

    def _estimate(self, simulation_s: float, control_s: float = 0.0) -> Estimate:
        """Estimate the label now, and record the step."""
        if not self._steps:
            self._touch = self._mounted_tip.tip_state()
        arm = self._mounted_tip.arm_model
        own = self._estimator.estimate(self._touch, arm.pose)
        measured = arm.measured_pose()
        if own.touching < _FREE * self._settings.contact_threshold:
            self._T_free, self._wrist_rad = measured, float(np.nan_to_num(arm.angles[5]))
        elif self._direction is not None:
            self._highest = max(self._highest, -float(measured[:3, 3] @ self._direction))
        self._trail.append(measured)
        estimate = self._filtered(own, measured)
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
                measured,
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
        beyond, own_beyond = (self._predicted(label)[1].max() for label in (fused.label, estimate.label))
        if beyond > self._settings.range_margin > own_beyond:
            # The motion contradicts the image, as where another part of the tip touches than before.
            self._filter.reset()
            fused = self._filter.step(T_base_tcp_measured, estimate.label, estimate.deviations)
        return replace(estimate, label=fused.label, deviations=fused.deviations)

    def _note(self, kind: str, what: str) -> None:
        self.events.append(Event(self._steps, kind, what))
        self._on_event(self.events[-1])


class FollowingFailed(Exception):
    """A route cannot be followed further; the message says why."""


def _angle_deg(estimate: Estimate) -> float:
    """Return the estimated angle, degrees, between the sensor's axis and the normal."""
    return float(np.degrees(np.linalg.norm(pose_error(estimate.label, np.zeros(6))[3:5])))
