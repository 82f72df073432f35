"""Following a surface or an edge by touch: make contact, keep the reference, move along a route, and get past obstacles.

At a failure the tip seeks contact again on the spot. If it fails again, it lifts off and touches down farther along the
route (obstacles.py); the stretch between is left out and reported. A run ends at the end of its route.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.control.estimator import Estimate, Estimator
from tactip_twin.control.obstacles import FollowingFailed, LeftOut, Obstacle, Tries
from tactip_twin.control.options import Settings
from tactip_twin.control.press import press_room_m
from tactip_twin.control.routes import Route
from tactip_twin.control.sensed_tip import SensedTip, Step
from tactip_twin.control.sensor_poses import moved, tilt_rad, tilted_at_most, turned_away
from tactip_twin.control.servo import Controller, pose_error
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, matrix, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import TipOnArm


@dataclass(frozen=True)
class Event:
    """An unplanned event."""

    step: int
    """Number of steps recorded before the event."""
    kind: str
    """contact lost, no contact, estimate out of range, force, collision, no progress, too steep, diverged, unreachable."""
    what: str
    """Description, with values."""


_SLOW_DEG = {"surface": 2.0, "edge": 0.0}
"""Default of Settings.slowdown_angle_deg by task."""

_EVASION_MM = 1.0
"""Motion back along the sensor's axis after a stop of the arm at its limit of force or a collision, mm [?]."""

_AWAY_RAD, _AWAY_M = np.radians(5.0), 3e-3
"""Angle by which the housing turns away from an obstacle after a collision, rad, and the travel along the route over which
it does not turn back, m [?]."""

_BEHIND_M, _MIN_ATTEMPT_M = 30e-3, 0.2e-3
"""Distance behind the apex of the middle of the housing's front part, m, and the least motion of it, m, that tells on which
side an obstacle is [?]."""

_LEANING_RAD = np.radians(30.0)
"""Angle to the route's direction of approach from which a leaning sensor turns towards that direction after a collision,
where its motion tells nothing, rad [?]."""

_MAX_APPROACH_RAD = np.radians(60.0)
"""Largest tilt from the route's direction of approach with which the sensor touches down, rad: leaning farther, it passes
the object or touches it with its housing first [?]."""

_ALIGNED_DEG = 3.0
"""Estimated angle to the normal from which the tip counts as aligned, degrees [?]."""

_ALIGNMENTS = 3
"""Longest alignment, as a multiple of Settings.alignment_steps: a sensor that has touched down far from the normal turns by
140 degrees at most [?]."""

_SMALL_STEP, _STOP = 0.2, 4.0
"""Fraction of the tangential step, -, below which it shrinks more slowly with the tilt, and the tilt at which it is zero, as
a multiple of the tilt at which it would have been (Settings.slowdown_angle_deg) [?]."""

_MAX_MOTION_M, _MAX_TURN_RAD = 2e-3, np.radians(4.0)
"""Longest motion and largest turn of a control step, m and rad: a turn about the apex moves the tip's flanks [?]."""

_SAME = 1e-9
"""Difference of two motions (4, 4) that rounding makes, m or -."""

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
        self._tip = SensedTip(mounted_tip, estimator, labels, settings, record, clock, pose_filter)
        self._controller, self._labels, self._settings = controller, labels, settings
        self._clock, self._on_event = clock, note
        self._followed_to_m, self._centred = 0.0, 0
        # Where the housing was to go in the last step, and the direction from which it keeps an angle, after a collision.
        self._attempted = np.zeros(3)
        self._barred: tuple[np.ndarray, float] | None = None
        self._barred_to_m = 0.0
        self.left_out: list[LeftOut] = []
        """Stretches of the route that were not followed."""
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
        self._T_good = T_start
        self._direction, self._tries = route.approach, Tries(self._settings, route.approach is not None)
        try:
            self._tip.place(T_start, route.wrist_rad, route.approach)
        except Unreachable as error:
            self.stopped_because = f"the start is out of reach: {error}"
            return
        try:
            self._follow(route)
        except FollowingFailed as reason:
            self.stopped_because = str(reason)

    @property
    def peak_force_n(self) -> float:
        """Maximum force on the tip so far, also within a step, N."""
        return self._tip.peak_force_n

    def _follow(self, route: Route) -> None:
        estimate: Estimate | None = None
        try:
            estimate = self._tip.search(self._settings.search_mm)
        except Obstacle as obstacle:
            if obstacle.kind == "no contact":
                raise FollowingFailed(str(obstacle)) from obstacle
            estimate = self._get_past(obstacle, route)
        while estimate is not None and self._tip.steps < self._settings.max_steps:
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
        measured, start, along = self._tip.pose, self._clock(), np.zeros(3)
        if aligning:
            self._tip.phase, self._centred = "centre", self._centred + 1
        else:
            self._tip.phase, self._centred = "follow", _ALIGNMENTS * self._settings.alignment_steps
            direction = route.direction(measured, measured @ inverse(sensor_in_contact(estimate.label)))
            self._tip.part = route.part
            if direction is None:
                return None
            self._T_good, self._followed_to_m = measured, route.travelled_m
            self._tries.followed(route.travelled_m)
            along = measured[:3, :3].T @ (self._step_fraction(estimate) * self._settings.step_mm / 1e3 * direction)
        if self._barred is not None and route.travelled_m > self._barred_to_m:
            # Free to turn back, which it does in place.
            self._barred, self._centred = None, self._settings.alignment_steps
        room_m = press_room_m(estimate.force_n, self._settings.ease_force_n)
        wanted = self._controller.move(self._in_range(estimate.label), along, room_m)
        clear = wanted if self._barred is None else inverse(measured) @ self._clear(measured @ wanted)
        motion = self._limited(clear)
        motion[2, 3] = min(motion[2, 3], room_m)
        if not np.allclose(motion, wanted, rtol=0, atol=_SAME):
            self._controller.limited_to(motion)
        return self._go(measured @ motion, self._clock() - start)

    def _clear(self, T: np.ndarray) -> np.ndarray:
        """Return a pose (4, 4), or the nearest whose housing is turned far enough from an obstacle."""
        return T if self._barred is None else turned_away(T, *self._barred)

    def _go(self, T: np.ndarray, control_s: float = 0.0) -> Estimate:
        """Move to a pose (4, 4), with the housing turned away from an obstacle, and estimate there. Raises Obstacle."""
        T = self._clear(T)
        here, behind = self._tip.pose, np.array([0.0, 0.0, -_BEHIND_M, 1.0])
        self._attempted = ((T - here) @ behind)[:3]
        return self._tip.go(T, control_s)

    def _evade(self, kind: str, route: Route) -> Estimate:
        """Move back a little after a stop of the arm or a collision; after a collision, also turn the housing away from the
        obstacle, and stay so for a while."""
        back = moved(self._tip.pose, None, -_EVASION_MM)
        side = self._obstacle_side(back) if kind == "collision" else None
        if side is not None:
            away_rad = np.pi - tilt_rad(back, side) + _AWAY_RAD
            self._barred, self._barred_to_m = (side, min(away_rad, np.pi)), route.travelled_m + _AWAY_M
        return self._go(back)

    def _obstacle_side(self, T: np.ndarray) -> np.ndarray | None:
        """Return the direction (3,), unit, square to the axis of a pose (4, 4), in which the housing has run against an
        obstacle: where it was to go. Where that tells nothing, a leaning sensor turns back to the route's direction of
        approach. None: unknown, as along an edge, from which a turn would lead the tip away [M]."""
        if self._direction is None:
            return None
        axis = T[:3, 2]
        side = self._attempted - (self._attempted @ axis) * axis
        if np.linalg.norm(side) < _MIN_ATTEMPT_M:
            if tilt_rad(T, self._direction) < _LEANING_RAD:
                return None
            side = self._direction - (self._direction @ axis) * axis
        return side / np.linalg.norm(side)

    def _is_aligning(self, estimate: Estimate) -> bool:
        """Return whether the tip still turns in place after contact: longer where it is far from the normal."""
        steps = self._settings.alignment_steps
        if self._centred < steps:
            return True
        return self._centred < _ALIGNMENTS * steps and self._free_tilt_deg(estimate) > _ALIGNED_DEG

    def _free_tilt_deg(self, estimate: Estimate) -> float:
        """Return the estimated angle, degrees, by which the sensor can turn towards the normal: zero where its housing would
        turn into an obstacle."""
        error = pose_error(estimate.label, np.zeros(6))[3:]
        square = self._tip.pose @ matrix(np.zeros(3), Rotation.from_rotvec(error))
        blocked = not np.allclose(self._clear(square), square, rtol=0, atol=_SAME)
        return 0.0 if blocked else float(np.degrees(np.linalg.norm(error[:2])))

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
        while self._tip.steps < self._settings.max_steps:
            self._note(obstacle.kind, str(obstacle))
            self._tip.phase, self._centred = "search", 0
            self._controller.reset()
            self._tip.forget()
            self._barred, self._attempted = None, np.zeros(3)
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
        self._tip.lift()
        height_mm = self._tip.height_mm(T)
        self._tip.travel(moved(T, self._direction, -height_mm))
        return self._tip.search(height_mm + self._tip.depth_mm(T), 3 * self._settings.search_step_mm, self._direction)

    def _step_fraction(self, estimate: Estimate) -> float:
        """Return the fraction of the tangential step to take: smaller where the sensor tilts, because it lags behind the
        surface, and zero where it is far from the normal, so that it turns in place."""
        slow = (
            _SLOW_DEG[self._labels.task] if self._settings.slowdown_angle_deg is None else self._settings.slowdown_angle_deg
        )
        if not slow:
            return 1.0
        tilt = self._free_tilt_deg(estimate) / slow
        return max(1 - tilt, _SMALL_STEP * (1 - tilt / _STOP), 0.0)

    def _failure(self, estimate: Estimate, aligning: bool) -> tuple[str, str] | None:
        """Return kind and description of a failure, or None. aligning: whether estimates may be out of range, because the
        tip turns in place."""
        danger, s = self._tip.danger(), self._settings
        if danger:
            return danger
        if estimate.touching < s.contact_threshold:
            difference = f"differs from that of an undeformed tip by {estimate.touching:.2f}"
            return "contact lost", f"the image {difference} (in contact: at least {s.contact_threshold:g})"
        predicted, out = self._tip.predicted(estimate.label)
        worst = int(out.argmax())
        if not np.isfinite(predicted).all() or (out[worst] > s.range_margin and not aligning):
            unit = self._labels.units[worst]
            return (
                "estimate out of range",
                f"{self._labels.names[worst]} predicted as {predicted[worst]:.1f} {unit} "
                f"(training range: {self._labels.low[worst]:g} to {self._labels.high[worst]:g})",
            )
        return None

    def _recover_from(self, kind: str) -> Estimate:
        """Search for contact; unless contact was lost, retract first. Return the new estimate. Raises Obstacle."""
        if kind != "contact lost":
            self._tip.go(moved(self._tip.pose, None, -self._settings.retract_mm))
        return self._tip.search(self._settings.search_mm / 2)

    def _note(self, kind: str, what: str) -> None:
        self.events.append(Event(self._tip.steps, kind, what))
        self._on_event(self.events[-1])
