"""The control law, the ground truth and the routes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.control.routes import EdgePath, Geodesic, PlanarPath, serpentine
from tactip_twin.control.servo import DEPTHS_MM, FREE_AXES, GAINS, Gains, Servo, gains_named, reference_mm_deg
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, label_of, matrix, sensor_in_contact
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.errors import TactipError

DOWN, STILL = Rotation.from_rotvec([0, np.pi, 0]), Rotation.identity()


@pytest.mark.parametrize("task", ["surface", "edge"])
@pytest.mark.parametrize("gains", GAINS)
def test_servo_from_any_pose_converges_to_the_reference(gains, task):
    """With exact estimates on a flat object; components without an estimate are not controlled."""
    components = [2, 3, 4] if task == "surface" else [0, 2, 3, 4, 5]
    rng = np.random.default_rng(0)
    for _ in range(10):
        T = sensor_in_contact(from_mm_deg(rng.uniform([-5, -5, -5, -15, -15, -45], [5, 5, -1, 15, 15, 45])))
        servo = Servo(gains_named(gains, task), DEPTHS_MM[task], FREE_AXES[task])
        for _ in range(60):
            label = np.zeros(6)
            label[components] = label_of(T)[components]
            T = T @ servo.move(label)
        assert np.allclose(label_of(T)[components], from_mm_deg(reference_mm_deg(DEPTHS_MM[task]))[components], atol=2e-5)


def test_servo_error_is_a_product_of_poses():
    servo = Servo(Gains(), 2.5)
    label = from_mm_deg([1, 2, -4, 5, -6, 30])
    error = servo.error(label)
    T = sensor_in_contact(label) @ matrix(error[:3], Rotation.from_rotvec(error[3:]))
    assert np.allclose(label_of(T), from_mm_deg(reference_mm_deg(2.5)), atol=1e-12)


def test_servo_move_is_proportional_and_integral_with_a_clipped_sum():
    servo = Servo(Gains(kp=(0.5,) * 6, ki=(0.3,) * 6, integral_limit_mm=2.0), 3.0)
    label = from_mm_deg([0, 0, -4, 0, 0, 0])  # 1 mm too deep: the reference is behind, at z = -1 mm of the sensor
    for expected in (-0.5 - 0.3, -0.5 - 0.6, -0.5 - 0.6):
        assert servo.move(label)[2, 3] == pytest.approx(expected * 1e-3)
    servo.reset()
    assert servo.move(label, along=(1e-3, 0, 0))[:3, 3] == pytest.approx([1e-3, 0, -0.8e-3])


@pytest.mark.parametrize(
    ("task", "label", "components"), [("edge", [2.4, 0, -3, 0, 0, -30], [1]), ("surface", [0, 0, -4, 15, 9, 0], [0, 1])]
)
def test_servo_integral_does_not_push_along_what_the_task_leaves_free(task, label, components):
    """Errors of a turned sensor have parts along its own axes, which remain when it has turned back."""
    servo = Servo(Gains(), 3.0, FREE_AXES[task])
    for _ in range(20):
        servo.move(from_mm_deg(label))
    moved = servo.move(from_mm_deg(reference_mm_deg(3.0)), along=(1e-3, 1e-3, 0))
    assert moved[components, 3] == pytest.approx([1e-3] * len(components), abs=1e-9)


def test_servo_kept_from_turning_does_not_overshoot_afterwards():
    """Held at a lean of 10 degrees for twenty steps, then free: it turns as if it had never been held."""
    label, held, fresh = from_mm_deg([0, 0, -2, 10, 0, 0]), Servo(Gains(), 2.0, (0, 1)), Servo(Gains(), 2.0, (0, 1))
    for _ in range(20):
        held.move(label)
        held.limited_to(np.eye(4))
    lean = {"held": [10.0], "fresh": [10.0]}
    for name, servo in (("held", held), ("fresh", fresh)):
        T = sensor_in_contact(label)
        for _ in range(30):
            T = T @ servo.move(label_of(T))
            lean[name].append(np.degrees(label_of(T)[3]))
    assert lean["held"] == pytest.approx(lean["fresh"], abs=1e-6)


def test_servo_integral_does_not_grow_where_the_motion_is_limited():
    servo = Servo(Gains(kp=(0.5,) * 6, ki=(0.3,) * 6), 3.0)
    label = from_mm_deg([0, 0, -4, 0, 0, 0])  # 1 mm too deep
    wanted = servo.move(label)[2, 3]
    servo.limited_to(matrix(np.array([0, 0, wanted / 4]), STILL))
    assert servo.move(label)[2, 3] == pytest.approx(wanted)
    servo.limited_to(matrix(np.array([1e-3, 0, wanted]), STILL))  # another component
    assert servo.move(label)[2, 3] == pytest.approx(wanted - 0.3e-3)


def test_servo_with_limited_turns_overshoots_no_more_than_from_a_small_lean():
    """A lean of 25 degrees, turned out by at most 4 degrees at a time."""
    servo, T, leans = Servo(Gains(), 2.0, (0, 1)), sensor_in_contact(from_mm_deg([0, 0, -2, 25, 0, 0])), []
    for _ in range(40):
        motion = servo.move(label_of(T))
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        turn *= min(1.0, np.radians(4.0) / max(np.linalg.norm(turn), 1e-9))
        servo.limited_to(matrix(motion[:3, 3], Rotation.from_rotvec(turn)))
        T = T @ matrix(motion[:3, 3], Rotation.from_rotvec(turn))
        leans.append(np.degrees(label_of(T)[3]))
    assert -2.0 < min(leans) < 0
    assert abs(leans[-1]) < 0.1


def test_servo_on_a_ball_has_no_steady_error():
    """On a ball the normal turns by the same angle at each step, which the integral compensates."""
    servo, radius, step = Servo(Gains(), 3.0), 0.06, 1e-3
    T = matrix([0, 0, radius - 3e-3], DOWN)
    for _ in range(150):
        apex = T[:3, 3]
        truth = SurfaceGroundTruth(_Ball(radius))
        label = truth.label(T)
        T = T @ servo.move(label, along=(step, 0, 0))
    assert abs(np.linalg.norm(apex) - (radius - 3e-3)) < 0.02e-3
    assert np.degrees(np.linalg.norm(label[3:5])) < 0.05


class _Ball:
    def __init__(self, radius):
        self.radius = radius

    def distance(self, points):
        return np.linalg.norm(points, axis=-1) - self.radius

    def smooth_normal(self, points):
        return points / np.linalg.norm(points, axis=1, keepdims=True)

    def nearest(self, points):
        from tactip_twin.sim.contact.signed_distance import Nearest

        normal = self.smooth_normal(points)
        return Nearest(self.distance(points), self.radius * normal, normal)


def test_surface_ground_truth_of_a_plate_is_the_label():
    """Over a flat top, wherever the object is and however it is turned."""
    scene_object = load_object("plate")
    truth, rng = SurfaceGroundTruth(scene_object.solid), np.random.default_rng(1)
    for _ in range(20):
        label = from_mm_deg(rng.uniform([0, 0, -5, -15, -15, 0], [0, 0, -1, 15, 15, 0]))
        spin = matrix(rng.uniform(-0.01, 0.01, 3) * [1, 1, 0], Rotation.from_euler("z", rng.uniform(0, 6)))
        assert np.allclose(truth.label(spin @ sensor_in_contact(label)), label, atol=1e-5)


@pytest.mark.parametrize("name", ["edge", "rim-round"])
def test_edge_ground_truth_is_the_label(name):
    scene_object = load_object(name)
    truth, rng = EdgeGroundTruth(scene_object.edge), np.random.default_rng(2)
    for k in range(5, 160, 31):
        at = scene_object.edge.points[k]
        frame = truth.frame(matrix(at, DOWN))
        assert np.allclose(frame[:3, 3], at, atol=1e-9)
        assert frame[:3, 0] @ (at - [0, 0, at[2]]) > 0  # x is off the object
        label = from_mm_deg(rng.uniform([-3, 0, -5, -15, -15, -45], [3, 0, -1, 15, 15, 45]))
        assert np.allclose(truth.label(frame @ sensor_in_contact(label)), label, atol=1e-5 if name == "edge" else 2e-4)
    assert truth.closed == (name != "edge")


def followed(route, T, steps, turn=STILL):
    """Return the places (n, 3) of a sensor that follows a route by 1 mm per step, aligned with the contact frame."""
    places = [T[:3, 3]]
    for _ in range(steps):
        direction = route.direction(T, T @ inverse(sensor_in_contact(np.zeros(6))))
        if direction is None:
            break
        assert np.linalg.norm(direction) == pytest.approx(1)
        assert abs(direction @ T[:3, 2]) < 1e-9
        T = matrix(T[:3, 3] + 1e-3 * direction, turn * Rotation.from_matrix(T[:3, :3]))
        places.append(T[:3, 3])
    return np.array(places)


def test_planar_path_serpentine_is_completed_part_by_part():
    corners = serpentine([0.4, 0, 0.1], [1, 0, 0], [0, 1, 0], 0.03, 0.02, 0.01)
    assert len(corners) == 6
    route = PlanarPath(corners, [0, 0, 1])
    places = followed(route, matrix(corners[0] + [0, 0, 0.05], DOWN), 500)
    assert route.ended == "route completed"
    assert route.part == 4
    assert np.linalg.norm(places[-1] - corners[-1] - [0, 0, 0.05]) < 1e-3
    # Every pass is reached, although corners are cut by the look-ahead.
    away = [np.abs(places[:, 1] - y).min() for y in corners[:, 1]]
    assert max(away) < 1e-4
    assert route.length_m == pytest.approx(0.11)


def test_geodesic_keeps_its_heading_and_ends_at_its_length():
    route = Geodesic(np.pi / 2, 0.01)
    places = followed(route, matrix([0, 0, 0], DOWN), 100)
    assert len(places) == 11
    assert np.allclose(np.diff(places, axis=0), [0, 1e-3, 0], atol=1e-9)


def test_edge_path_closes_a_loop_and_stops_at_its_limit_on_a_straight_edge():
    route = EdgePath(step_m=1e-3)
    places = followed(route, matrix([0.06, 0, 0], DOWN), 1000, Rotation.from_euler("z", 1e-3 / 0.06))
    assert route.closed
    assert len(places) == pytest.approx(2 * np.pi * 60, abs=3)
    straight = EdgePath(max_length_m=0.05, backward=True)
    places = followed(straight, matrix([0, 0, 0], DOWN), 1000)
    assert not straight.closed
    assert straight.ended == "stopped at the path limit of 50 mm"
    assert np.allclose(places[-1], [0, 0.0505, 0], atol=0.6e-3)  # the contact frame's y is opposite to the base frame's here


def test_gains_named_unknown_name_is_refused():
    with pytest.raises(TactipError, match="paper, tactile-servo-control"):
        gains_named("high", "edge")
