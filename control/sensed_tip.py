"""A tip on an arm that feels what it does: it moves, estimates after each motion, records, and tells what is dangerous.

It knows the arm's measured pose and what its estimator returns. The force limit belongs to the arm: it is a protective stop,
as robots have.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tactip_twin.control.estimator import Estimate, Estimator
from tactip_twin.control.obstacles import FollowingFailed, Obstacle
from tactip_twin.control.options import Settings
from tactip_twin.control.sensor_poses import moved, tilted_at_most
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import interpolate, to_mm_deg
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import TipOnArm, clear_pose
from tactip_twin.tactip_model.errors import TactipError


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


_TRANSIT_M = 10e-3
"""Longest motion through the air between two checks of force and clearance, m."""

_DROP_MM = 40.0
"""Depth below a place on the route at which the object is still sought, mm: a neck below a chin [?]."""

_BACK_STEPS = 5
"""Number of steps that the tip goes back before the arm tries again to lift it."""

_MIN_TRAIL = 50
"""Number of steps that the tip can go back at least, where the arm cannot lift a free tip at a limit of its joints."""

_PULL = 2.0
"""Force at which the arm stops while it pulls a held tip free, over Settings.max_force_n [?]."""

_FREE = 0.1
"""Fraction of Settings.contact_threshold below which the tip counts as free, -."""

_MAX_DIVERGED = 20
"""Number of divergences of the simulation after which a run ends."""


class SensedTip:
    """A tip on an arm, with its estimates."""

    def __init__(
        self,
        mounted_tip: TipOnArm,
        estimator: Estimator,
        labels: Labels,
        settings: Settings,
        record: Callable[[Step], None],
        clock: Callable[[], float],
        pose_filter: PoseFilter | None = None,
    ) -> None:
        """Take the parts, as of follow.ContourFollower."""
        self._mounted_tip, self._estimator, self._labels, self._settings = mounted_tip, estimator, labels, settings
        self._record, self._clock, self._filter = record, clock, pose_filter
        self._trail: list[np.ndarray] = []
        """Poses (4, 4) since the tip was last free, and some before."""
        self._approach: np.ndarray | None = None
        self._highest, self._lowest, self._diverged = -np.inf, np.inf, 0
        self.phase, self.part = "search", 0
        """Phase and part of the next steps (Step)."""
        self.steps = 0
        """Number of steps so far."""
        self.peak_force_n = 0.0
        """Maximum force on the tip so far, also within a step, N."""

    def place(self, T_base_tcp: np.ndarray, wrist_rad: float, approach: np.ndarray | None) -> None:
        """Place the undeformed tip at a pose (4, 4) with an angle of the wrist.

        approach: (3,) unit, base frame, direction of approach; None: the sensor's own.

        Raises:
            Unreachable: The arm cannot take the pose.
            TactipError: The pose is inside the object.
        """
        self._T_free, self._wrist_rad, self._approach = T_base_tcp, wrist_rad, approach
        self._mounted_tip.reset_to(T_base_tcp, wrist_rad)
        self.touch = self._mounted_tip.tip_state()

    @property
    def pose(self) -> np.ndarray:
        """The sensor's pose (4, 4) as the joints measure it."""
        return self._mounted_tip.arm_model.measured_pose()

    def forget(self) -> None:
        """Forget earlier estimates."""
        if self._filter is not None:
            self._filter.reset()

    def height_mm(self, T: np.ndarray) -> float:
        """Return the height above a pose (4, 4), mm, at which the tip is clear of what it has touched so far."""
        if self._approach is None:
            return self._settings.clearance_mm
        return self._settings.clearance_mm + 1e3 * max(0.0, self._highest + float(T[:3, 3] @ self._approach))

    def depth_mm(self, T: np.ndarray) -> float:
        """Return how far below a pose (4, 4) the object may still be, mm: at least to the lowest place touched so far."""
        if self._approach is None:
            return self._settings.clearance_mm
        to_lowest_mm = -1e3 * (self._lowest + float(T[:3, 3] @ self._approach))
        return max(_DROP_MM, to_lowest_mm + self._settings.clearance_mm)

    def lift(self) -> None:
        """Lift off. Where the arm cannot, at a limit of its joints, or stops, because an undercut holds skin or housing, go
        back the way the tip came until it can, past where it was free. At last, turn to the route's direction of approach on
        the way up and pull, with more force.

        Raises:
            Obstacle: As of `go`.
            FollowingFailed: The tip cannot be pulled free.
        """
        trail = self._trail[::-1]
        for k in range(0, len(trail), _BACK_STEPS):
            try:
                if self._rise():
                    return
            except Obstacle as obstacle:
                if obstacle.kind != "unreachable":
                    raise
            for pose in trail[k : k + _BACK_STEPS]:
                self.go(pose)
        here = self.pose
        for pose in self._way_to(tilted_at_most(moved(here, self._approach, -self.height_mm(here)), self._approach, 0.0)):
            self.go(pose)
            if self.touch.stopped_by:
                limit_n = _PULL * self._settings.max_force_n
                self.go(pose, max_force_n=limit_n)
                if self.touch.stopped_by:
                    held = self.touch.stopped_by == "force"
                    why = f"{limit_n:g} N do not free it" if held else "the sensor's housing runs against it on the way up"
                    raise FollowingFailed(f"the object holds the tip, and {why}")

    def _rise(self) -> bool:
        """Retract and move to a height that is clear; return False as soon as the arm stops. Raises Obstacle."""
        retracted = moved(self.pose, None, -self._settings.retract_mm)
        for T in (retracted, moved(retracted, self._approach, -self.height_mm(retracted))):
            for pose in self._way_to(T):
                self.go(pose)
                if self.touch.stopped_by:
                    return False
        return True

    def _way_to(self, T: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the poses (4, 4) of a motion through the air to a pose T (4, 4)."""
        start = self.pose
        count = max(1, int(np.ceil(np.linalg.norm(T[:3, 3] - start[:3, 3]) / _TRANSIT_M)))
        for k in range(1, count + 1):
            yield interpolate(start, T, k / count)

    def travel(self, T: np.ndarray) -> None:
        """Move to a pose (4, 4) through the air. Raises Obstacle, also where the tip touches something on the way."""
        for pose in self._way_to(T):
            self.go(pose)
            danger = self.danger()
            if danger:
                raise Obstacle(*danger)

    def danger(self) -> tuple[str, str] | None:
        """Return kind and description of a failure that could cause damage, whatever the estimate, or None."""
        touch, limit = self.touch, self._settings.max_force_n
        force = touch.peak_force_n if touch.stopped_by == "force" else float(np.linalg.norm(touch.force))
        if force > limit:
            return "force", f"{force:.1f} N on the tip (at most {limit:g} N)"
        if touch.clearance_m < 0 or touch.stopped_by == "housing":
            gap_mm = 1e3 * touch.clearance_m
            now = f"{-gap_mm:.1f} mm in it" if gap_mm < 0 else f"{gap_mm:.1f} mm from it"
            return "collision", f"the sensor's housing ran against the object, and is {now} now"
        return None

    def search(self, max_mm: float, step_mm: float | None = None, direction: np.ndarray | None = None) -> Estimate:
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
            danger = self.danger()
            if danger:
                raise Obstacle(danger[0], f"no contact detected in the image, but {danger[1]}")
            if travelled_mm >= max_mm:
                raise Obstacle("no contact", f"no contact detected within {max_mm:g} mm")
            estimate = self.go(moved(self.pose, direction, step_mm))
            travelled_mm += step_mm
        return estimate

    def go(self, T: np.ndarray, control_s: float = 0.0, max_force_n: float | None = None) -> Estimate:
        """Move to a pose (4, 4) and estimate there. max_force_n: Force at which the arm stops; that of the settings if None.
        Raises Obstacle if that is impossible."""
        start = self._clock()
        try:
            self.touch = self._mounted_tip.go(T, self._settings.max_force_n if max_force_n is None else max_force_n)
            self.peak_force_n = max(self.peak_force_n, self.touch.peak_force_n)
        except Unreachable as error:
            raise Obstacle("unreachable", str(error)) from error
        except Diverged as error:
            self._restart()
            raise Obstacle("diverged", str(error)) from error
        return self._estimate(self._clock() - start, control_s)

    def predicted(self, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the components of a label (6,), m and rad, that the network predicts, mm and degrees, and how far they are
        beyond their trained ranges, as fractions of the ranges' half widths; both (k,)."""
        low, high = np.array(self._labels.low), np.array(self._labels.high)
        predicted = to_mm_deg(label)[[COMPONENTS.index(c) for c in self._labels.components]]
        return predicted, np.maximum(low - predicted, predicted - high) / ((high - low) / 2)

    def _restart(self) -> None:
        """Restart with an undeformed tip, where the tip was last free."""
        self._diverged += 1
        if self._diverged > _MAX_DIVERGED:
            raise FollowingFailed(f"the simulation diverged more than {_MAX_DIVERGED} times")
        try:
            self._mounted_tip.reset_to(clear_pose(self._mounted_tip, self._T_free), self._wrist_rad)
        except TactipError as error:
            raise FollowingFailed(f"the simulation diverged and cannot restart where the tip was free: {error}") from error
        self.touch = self._mounted_tip.tip_state()

    def _estimate(self, simulation_s: float, control_s: float = 0.0) -> Estimate:
        """Estimate the label now, and record the step."""
        arm = self._mounted_tip.arm_model
        own = self._estimator.estimate(self.touch, arm.pose)
        measured = arm.measured_pose()
        if own.touching < _FREE * self._settings.contact_threshold:
            self._T_free, self._wrist_rad = measured, float(np.nan_to_num(arm.angles[5]))
            del self._trail[:-_MIN_TRAIL]
        elif self._approach is not None:
            height_m = -float(measured[:3, 3] @ self._approach)
            self._highest, self._lowest = max(self._highest, height_m), min(self._lowest, height_m)
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
                self.phase,
                self.part,
                arm.pose,
                measured,
                arm.angles,
                self.touch,
                estimate,
                own.label,
                seconds,
            )
        )
        self.steps += 1
        return estimate

    def _filtered(self, estimate: Estimate, T_base_tcp_measured: np.ndarray) -> Estimate:
        """Return an estimate fused with those before it; as it is without a filter, without deviations or in the air."""
        if self._filter is None or estimate.deviations is None:
            return estimate
        if estimate.touching < self._settings.contact_threshold:
            self._filter.reset()
            return estimate
        fused = self._filter.step(T_base_tcp_measured, estimate.label, estimate.deviations)
        beyond, own_beyond = (self.predicted(label)[1].max() for label in (fused.label, estimate.label))
        if beyond > self._settings.range_margin > own_beyond:
            # The motion contradicts the image, as where another part of the tip touches than before.
            self._filter.reset()
            fused = self._filter.step(T_base_tcp_measured, estimate.label, estimate.deviations)
        return replace(estimate, label=fused.label, deviations=fused.deviations)
