"""A twin of one's own sensor: a design and a rig fitted to real frames.

The neutral image gives lens, camera and pins (tactip_model/neutral_image.py). Pressed frames, of which only the rig's
commands are
known, give the rest: each parameter is a value, bounds, what is believed of it beforehand, and a function that writes it
into the twin. Gauss and Newton's method on the distance between pins seen and pins simulated, every contact played anew for
each parameter that the mechanics depend on.

An image is not always taken where the label says: cameras lag, and frames of a rig's moves show the tip before or amid
the move that its row says is over. How much of the move is done is therefore found for each frame, from the frame.
"""

import json
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from tqdm import tqdm

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import LEVER_M, ContactSimulator
from tactip_twin.sim2real.calibration.parameters import UNKNOWN_CAMERA, Parameter, SensorOnRig, parameters
from tactip_twin.sim2real.calibration.real_set import read_real_set
from tactip_twin.sim2real.calibration.rig import Rig, RigMotion
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.neutral_image import as_built, camera_change, fit_neutral, reference_pixels
from tactip_twin.tactip_model.optics import REFERENCE_PX, Lens
from tactip_twin.tactip_model.pin_detection import PinMatcher, find_blobs
from tactip_twin.tactip_model.pins import PinReader

DONE = np.linspace(0, 1, 6)
"""Shares of a move at which a contact is looked at; between them, pins are taken to move in straight lines."""

LOAD_CELL_N = {1e-3: 0.21, 2e-3: 0.8, 3e-3: 1.85}
"""Normal force, N, of a TacTip pressed by so many m on the flat [R: a load cell under an aerial TacTip]. Images tell the
ratio of two moduli and not their size; this does."""

_FORCE_SPREAD = 0.15
"""Standard deviation of the logarithm of such a force, -."""

_PIXEL_SPREAD = 0.5
"""What a good fit leaves, px of 256."""

_INDEPENDENT = 10
"""Pins of a frame err together: it counts for so many independent numbers."""

_OUTLIER_PX = 1.0
"""A frame farther off than this, px of 256, is not explained by the model: it pulls no harder than one at this distance."""

_TURNS = 12
"""Azimuths that are tried first."""

_DAMPING = 0.01
"""Levenberg's share of the diagonal."""


_CAMERA_SPREAD = np.array([0.0005, 0.001, 0.001])
"""Least standard deviations of what reflections tell of them."""


@dataclass(frozen=True)
class Settings:
    """How a calibration is run."""

    frames: int = 60
    """Frames that are fitted; drawn from the first half of the set (rows 0, 2, 4 …)."""
    judged: int = 150
    """Frames that are judged; drawn from the other half (rows 1, 3, 5 …)."""
    rounds: tuple[str, ...] = ("draft", "draft", "standard", "standard")
    """Fidelity of each round of the fit."""
    judging: str = "standard"
    """Fidelity of the judgement."""
    seed: int = 0
    """Seed of the draws of frames."""


@dataclass
class Frames:
    """Some frames of a real set, with their pins. (n frames, p pins)"""

    indices: np.ndarray
    """(n,) int: rows of the set."""
    pins_px: np.ndarray
    """(n, p, 2) float: pins seen, px of a 256 px image; NaN where one is not."""
    commands: list = field(default_factory=list)
    """n pairs of pose and move, (6,) each, m and rad, in the rig's frame."""
    tap: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """(6,), m and rad."""


def chosen_frames(real, matcher, odd, count, generator):
    """Draw `count` frames of a RealSet's odd or even rows and find their pins. Returns Frames.

    matcher: blobs.PinMatcher in the frames' px. generator: numpy Generator. Raises TactipError where pins are not found.
    """
    rows = np.arange(len(real.files))[1 if odd else 0 :: 2]
    if len(rows) < 10:
        raise TactipError(f"{real.folder} has {len(real.files)} frames: a calibration needs at least 20")
    indices = np.sort(generator.choice(rows, min(count, len(rows)), replace=False))
    width = real.neutral.shape[1]
    found = [reference_pixels(matcher.match(find_blobs(real.frame(i))), width) for i in indices]
    pins = np.array(found)
    seen = np.isfinite(pins[..., 0]).mean(1)
    good = seen > 0.9
    if good.mean() < 0.7:
        worst = real.files[indices[seen.argmin()]]
        raise TactipError(f"in {(~good).sum()} of {len(good)} frames fewer than 90 % of the pins are found, as in {worst}")
    kept = indices[good]
    return Frames(kept, pins[good], [(real.poses[i], real.moves[i]) for i in kept], real.tap)


# Work for other processes: everything comes in the arguments, and the players are kept, for a mesh takes its time.


@lru_cache(maxsize=4)
def _player(design, fidelity):
    return ContactSimulator(design, "surface", fidelity_named(fidelity))


def _mechanical(design):
    """A Design without what the mechanics do not depend on, so that players are shared."""
    plain = Design(design.name)
    return replace(plain, shape=design.shape, materials=design.materials)


def _skin(player):
    return player.scene.vertices()[: player.scene.mesh.surface_count]


def _play(job):
    """Skins (n, s, 3) m of contacts. job: design, rig, fidelity, commands, tap, and the share done of each move."""
    design, rig, fidelity, commands, tap, done = job
    player, motion = _player(_mechanical(design), fidelity), RigMotion(rig)
    skins = []
    for (pose, move), share in zip(commands, done, strict=True):
        player.play(*motion.contact(pose, move, tap, share))
        skins.append(_skin(player))
    return np.array(skins)


def _stages(job):
    """Skins (n, DONE, s, 3) m of contacts at each share of the move. job: as for _play, without the last."""
    design, rig, fidelity, commands, tap = job
    player, motion = _player(_mechanical(design), fidelity), RigMotion(rig)
    contacts = (motion.contact(pose, move, tap) for pose, move in commands)
    return np.array([[_skin(player) for _ in player.stages(*contact, DONE)] for contact in contacts])


def _forces(job):
    """Normal forces (3,) N at the depths of LOAD_CELL_N. job: design, fidelity."""
    player = _player(_mechanical(job[0]), job[1])
    return np.array([player.play([0, 0, -depth, 0, 0, 0], np.zeros(6)).normal_force_n for depth in LOAD_CELL_N])


def _ignore_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def pixels(design, fidelity, skins):
    """Where a Design's pins appear, (..., p, 2) px of 256, with skins (..., s, 3) m of the mesh of a fidelity (str)."""
    lens = Lens(design)
    tips, _ = PinReader(design, build_mesh(design.shape, fidelity_named(fidelity).mesh)).read(skins)
    return reference_pixels(lens.project(tips), lens.width)


def distances(predicted, seen):
    """Root mean square distance (...,) px between pins predicted and seen (..., p, 2), over those that are seen."""
    return np.sqrt(np.nanmean(((predicted - seen) ** 2).sum(-1), -1))


def best_share(stages, seen):
    """Where pins at each stage (n, DONE, p, 2) come nearest to those seen (n, p, 2).

    Returns the shares done (n,), the pins there (n, p, 2), and how they change with the share (n, p, 2), px; no change
    where the share is at one of its ends, and cannot give way.
    """
    fine = np.linspace(0, 1, 51)
    left = np.minimum((fine * (len(DONE) - 1)).astype(int), len(DONE) - 2)
    weight = (fine * (len(DONE) - 1) - left)[:, None, None]
    shares, pins, tangents = np.empty(len(seen)), np.empty_like(seen), np.zeros_like(seen)
    for i, stage in enumerate(stages):
        between = (1 - weight) * stage[left] + weight * stage[left + 1]
        best = distances(between, seen[i]).argmin()
        shares[i], pins[i] = fine[best], between[best]
        if 0 < best < len(fine) - 1:
            tangents[i] = stage[left[best] + 1] - stage[left[best]]
    return shares, pins, tangents


def robust(rms):
    """Huber's cost (float) of frames' rms distances (n,) px: squares up to _OUTLIER_PX, straight beyond."""
    return float(np.where(rms < _OUTLIER_PX, rms**2, _OUTLIER_PX * (2 * rms - _OUTLIER_PX)).mean())


class Calibrator:
    """Fits a SensorOnRig to Frames."""

    def __init__(self, frames, neutral_pins_px, executor):
        """frames: Frames. neutral_pins_px: (p, 2), px of 256, of the neutral image. executor: of worker processes."""
        self._frames, self._neutral, self._executor = frames, neutral_pins_px, executor

    def stages(self, twin, fidelity, frames=None):
        """Pins (n, DONE, p, 2) px of 256 at each share of each frame's move."""
        frames = frames or self._frames
        parts = np.array_split(np.arange(len(frames.commands)), min(16, len(frames.commands)))
        jobs = [(twin.design, twin.rig, fidelity, [frames.commands[i] for i in part], frames.tap) for part in parts]
        skins = np.concatenate(list(self._progress(_stages, jobs, "shares of the moves")))
        return pixels(twin.design, fidelity, skins)

    def misfit(self, twin, fidelity, few=12):
        """Median distance (px) of the `few` frames with most tilt and move from a SensorOnRig's, moved already or not
        yet."""
        commands = self._frames.commands
        told = [np.linalg.norm(pose[3:]) + np.linalg.norm(move[:3]) / LEVER_M for pose, move in commands]
        chosen = np.argsort(told)[-few:]
        jobs = [(twin.design, twin.rig, fidelity, [commands[i]] * 2, self._frames.tap, [0.0, 1.0]) for i in chosen]
        pins = pixels(twin.design, fidelity, np.array(list(self._executor.map(_play, jobs))))
        return float(np.median(distances(pins, self._frames.pins_px[chosen][:, None]).min(1)))

    def forces(self, twin, fidelity):
        """Normal forces (3,) N at the depths of LOAD_CELL_N."""
        return next(iter(self._executor.map(_forces, [(twin.design, fidelity)])))

    def cost(self, twin, chosen, fidelity):
        """The cost (float), px², of a SensorOnRig, and its pins (n, DONE, p, 2) px at each share of each frame's move.

        The frames' robust cost and, in its unit, what forces and the Parameters `chosen` are off what is believed.
        """
        stages = self.stages(twin, fidelity)
        frames = robust(distances(best_share(stages, self._frames.pins_px)[1], self._frames.pins_px))
        strange = np.concatenate([self._force_misfit(twin, fidelity), [p.surprise(twin) for p in chosen]])
        return frames + float((strange**2).sum()) * 2 * _PIXEL_SPREAD**2 / (_INDEPENDENT * len(stages)), stages

    def _force_misfit(self, twin, fidelity):
        """How far (3,), in standard deviations, forces are from LOAD_CELL_N."""
        return np.log(self.forces(twin, fidelity) / list(LOAD_CELL_N.values())) / _FORCE_SPREAD

    def round(self, twin, chosen, fidelity):
        """One step of Gauss and Newton. chosen: Parameters. Returns the new SensorOnRig, deviations (k,) and a dict of
        figures.

        Parameters that are searched stay, with the deviations that they are believed to have.

        The share of its move belongs to each frame alone: it is taken out of residuals and slopes (variable projection), so
        that no parameter is moved for what a share can do as well. A step that does not lower the cost is halved.
        """
        seen = self._frames.pins_px
        smooth = [p for p in chosen if not p.searched]
        cost, stages = self.cost(twin, chosen, fidelity)
        done, _, tangents = best_share(stages, seen)
        mechanical = [p for p in smooth if p.mechanical]
        twins = [twin] + [p.moved(twin, 1.0) for p in mechanical]
        jobs = [(t.design, t.rig, fidelity, self._frames.commands, self._frames.tap, done) for t in twins]
        skins = dict(zip([None] + [p.name for p in mechanical], self._progress(_play, jobs, "slopes"), strict=True))
        pressed = list(self._executor.map(_forces, [(t.design, fidelity) for t in twins]))
        forces = dict(zip([None] + [p.name for p in mechanical], pressed, strict=True))

        here = pixels(twin.design, fidelity, skins[None])
        rms = distances(here, seen)
        weight = np.sqrt(np.minimum(1, _OUTLIER_PX / np.maximum(rms, 1e-9))) / _PIXEL_SPREAD
        weight = weight * np.sqrt(_INDEPENDENT / (2 * np.isfinite(seen[..., 0]).sum(1)))
        expected = np.array(list(LOAD_CELL_N.values()))
        along = np.where(np.isfinite(seen), tangents, 0.0).reshape(len(seen), -1)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)

        def residual(pins):
            wrong = (np.nan_to_num(pins - seen) * weight[:, None, None]).reshape(len(seen), -1)
            return wrong - (wrong * along).sum(1, keepdims=True) * along

        slopes, force_slopes = [], []
        for p in smooth:
            moved = p.moved(twin, 1.0)
            design = self._rebuilt(moved).design if not p.mechanical else twin.design
            pins = pixels(design, fidelity, skins[p.name if p.mechanical else None])
            slopes.append(residual(pins) - residual(here))
            force_slopes.append(np.log(forces[p.name if p.mechanical else None] / forces[None]) / _FORCE_SPREAD)
        slopes, force_slopes = np.array(slopes), np.array(force_slopes)
        by_frame = np.einsum("kni,ni->nk", slopes, residual(here))
        surprise = np.array([p.surprise(twin) for p in smooth])
        belief = np.array([0.0 if p.believed is None else p.step / p.believed[1] for p in smooth])
        misfit = np.log(forces[None] / expected) / _FORCE_SPREAD
        curvature = np.einsum("kni,lni->kl", slopes, slopes) + force_slopes @ force_slopes.T + np.diag(belief**2)
        gradient = by_frame.sum(0) + force_slopes @ misfit + belief * surprise
        change = -np.linalg.solve(curvature + _DAMPING * np.diag(np.diag(curvature)), gradient)
        # Frames, not pins, are what is independent: deviations by the spread of what each frame asks for.
        inverse = np.linalg.inv(curvature)
        spread = by_frame.T @ by_frame + force_slopes @ force_slopes.T + np.diag(belief**2)
        deviations = np.sqrt(np.diag(inverse @ spread @ inverse))
        found = dict(zip([p.name for p in smooth], deviations, strict=True))
        deviations = np.array([found.get(p.name, p.believed[1] / p.step if p.believed else np.inf) for p in chosen])
        changes = dict(zip(smooth, np.clip(change, -8, 8), strict=True))
        new, after, share = self._lowest(twin, chosen, changes, fidelity, cost)
        figures = {"fidelity": fidelity, "rms_px": float(np.sqrt((rms**2).mean())), "median_px": float(np.median(rms))}
        figures |= {"cost_before": cost, "cost_after": after, "share_of_step": share, "forces_n": forces[None].tolist()}
        return new, deviations, figures

    def _lowest(self, twin, chosen, changes, fidelity, cost):
        """The first SensorOnRig along `changes` (dict of Parameter to steps) below `cost`, its cost, and the share taken."""
        for share in (1.0, 0.5, 0.25):
            new = twin
            for p, amount in changes.items():
                new = p.moved(new, share * amount)
            new = self._rebuilt(new)
            after, _ = self.cost(new, chosen, fidelity)
            if after < cost:
                return new, after, share
        return twin, cost, 0.0

    def search(self, twin, chosen, deviations, fidelity):
        """Try each searched Parameter of `chosen` a step up and down, and keep what lowers the cost.

        Returns the new SensorOnRig, the deviations (k,), with those of the searched by a parabola through three costs,
        and a dict
        of figures.
        """
        before, _ = self.cost(twin, chosen, fidelity)
        here, deviations = before, deviations.copy()
        strange = _INDEPENDENT * len(self._frames.commands) / (2 * _PIXEL_SPREAD**2)
        for k, p in enumerate(chosen):
            if not p.searched:
                continue
            tried = {amount: p.moved(twin, amount) for amount in (-1.0, 1.0)}
            costs = {amount: self.cost(t, chosen, fidelity)[0] for amount, t in tried.items()}
            bend = strange * ((costs[-1.0] + costs[1.0]) / 2 - here)
            if bend > 0:
                deviations[k] = min(deviations[k], 1 / np.sqrt(bend))
            best = min(costs, key=costs.__getitem__)
            if costs[best] < here:
                twin, here = tried[best], costs[best]
        return twin, deviations, {"fidelity": fidelity, "searched": True, "cost_before": before, "cost_after": here}

    def _rebuilt(self, twin):
        """The SensorOnRig with its pins where the neutral image has them, as it was when that was taken."""
        return replace(twin, design=as_built(twin.design, self._neutral))

    def _progress(self, work, jobs, what):
        return list(tqdm(self._executor.map(work, jobs), total=len(jobs), desc=what, leave=False))


def calibrate(real_dir, design, settings, state_path, say=print):
    """Fit a Design, and the rig, to a folder of real frames.

    real_dir: path of a real set. design: Design to start from. settings: Settings. state_path: file in which the state is
    kept after each round: a run that was stopped goes on from there. say: takes a line of text.

    Returns a Result. Raises TactipError on frames that do not fit the design, and where state_path is of another run.
    """
    real = read_real_set(real_dir)
    started, neutral = fit_neutral(design, real.neutral)
    say(
        f"neutral image: {neutral.before_px:.2f} px rms as it came, {neutral.lattice_px:.2f} px with lens, camera and turn "
        "fitted, the rest is how the pins were built (256 px image)"
    )
    width = real.neutral.shape[1]
    matcher = PinMatcher((neutral.pins_px[np.isfinite(neutral.pins_px[:, 0])] + 0.5) * width / REFERENCE_PX - 0.5)
    if not np.isfinite(neutral.pins_px).all():
        raise TactipError("some pins are hidden in the neutral image: every pin must be seen there")
    draws = np.random.default_rng(np.random.SeedSequence(settings.seed)).spawn(2)
    fitted = chosen_frames(real, matcher, False, settings.frames, draws[0])
    axis = np.array(started.optics.centre) * width - 0.5
    camera = camera_change(real.neutral, (real.frame(i) for i in fitted.indices), axis)
    if camera is None:
        say("too little light at the rim to tell by it how the camera has changed since the neutral image")
        camera = UNKNOWN_CAMERA
    else:
        say(f"reflections at the rim: the image is {camera[0][0]:.4f} times the neutral one ({camera[1][0]:.4f} a frame)")
        camera = camera[0], np.maximum(camera[1], _CAMERA_SPREAD)
    chosen = parameters(design, camera)
    press = real.tap[:3] / np.linalg.norm(real.tap[:3])
    twin = SensorOnRig(started, Rig(press_axis=tuple(float(x) for x in press)))
    for p in chosen:
        # What the neutral image does not tell, and what a perfect sensor has at its bound.
        if p.believed and (p.part == "optics" or p.name.startswith("kinetic")):
            twin = p.write(twin, p.believed[0])
    identity = {"real": str(Path(real_dir).name), "design": asdict(design), "settings": asdict(settings)}
    identity["parameters"] = [p.name for p in chosen]
    identity = json.loads(json.dumps(identity))
    rounds, deviations = [], None
    if Path(state_path).exists():
        twin, deviations, rounds = _read_state(state_path, identity, twin, chosen, neutral.pins_px)
        say(f"going on after round {len(rounds)} of {len(settings.rounds)}")
    with ProcessPoolExecutor(min(2, os.cpu_count() or 1), initializer=_ignore_interrupts) as executor:
        calibrator = Calibrator(fitted, neutral.pins_px, executor)
        try:
            if not rounds:
                twin = first_azimuth(calibrator, twin, settings.rounds[0])
            for fidelity in settings.rounds[len(rounds) :]:
                twin, deviations, figures = calibrator.round(twin, chosen, fidelity)
                text = _round_text(figures)
                if fidelity == settings.judging:
                    twin, deviations, searched = calibrator.search(twin, chosen, deviations, fidelity)
                    figures["search"] = searched
                    text += f"; friction searched, to {searched['cost_after']:.3f} px²"
                rounds.append(figures)
                _write_state(state_path, identity, twin, deviations, rounds, chosen)
                say(f"round {len(rounds)} of {len(settings.rounds)} ({fidelity}): {text}")
            judged = chosen_frames(real, matcher, True, settings.judged, draws[1])
            stages = calibrator.stages(twin, settings.judging, judged)
            forces = calibrator.forces(twin, settings.judging)
        except KeyboardInterrupt:
            executor.shutdown(wait=False, cancel_futures=True)
            raise Interrupted("the same command goes on after the last round") from None
    return Result(twin, chosen, deviations, neutral, rounds, judged, stages, forces)


def _round_text(figures):
    """A round's figures (dict) as text for people."""
    return (
        f"began at {figures['rms_px']:.2f} px rms, median frame {figures['median_px']:.2f} px; cost "
        f"{figures['cost_before']:.3f} to {figures['cost_after']:.3f} px² by {figures['share_of_step']:g} of the step"
    )


@dataclass(frozen=True)
class Result:
    """What a calibration found, and what it says of frames that it was not fitted to."""

    twin: SensorOnRig
    """The sensor and its rig, as fitted."""
    chosen: tuple[Parameter, ...]
    """(k) what was fitted, in the order of `deviations`."""
    deviations: np.ndarray
    """(k,) float: standard deviation of each parameter, in its steps."""
    neutral: object
    """neutral.NeutralFit."""
    rounds: list
    """A dict of figures for each round."""
    judged: Frames
    """Frames that it was not fitted to."""
    stages: np.ndarray
    """(n, DONE, p, 2) float: pins of the judged frames at each share of their moves, px of 256."""
    forces_n: np.ndarray
    """(3,) float: normal forces at the depths of LOAD_CELL_N."""


def first_azimuth(calibrator, twin, fidelity):
    """The SensorOnRig with the best of _TURNS azimuths: the fit itself only finds the nearest."""
    azimuth = next(p for p in parameters(twin.design) if p.name == "azimuth")
    candidates = [azimuth.write(twin, 360 * k / _TURNS - 180) for k in range(_TURNS)]
    return min(candidates, key=lambda candidate: calibrator.misfit(candidate, fidelity))


def _write_state(path, identity, twin, deviations, rounds, chosen):
    values = {p.name: p.read(twin) for p in chosen}
    state = {"of": identity, "values": values, "deviations": deviations.tolist(), "rounds": rounds}
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_file(Path(path), json.dumps(state, indent=1).encode())


def _read_state(path, identity, twin, chosen, neutral_px):
    try:
        state = json.loads(Path(path).read_text())
        same = state["of"] == identity
    except (ValueError, KeyError, TypeError) as error:
        raise TactipError(f"{path} is no state of a calibration ({error}): remove it to begin anew") from error
    if not same:
        raise TactipError(f"{path} is of a calibration with other settings: remove it to begin anew")
    for p in chosen:
        twin = p.write(twin, state["values"][p.name])
    twin = replace(twin, design=as_built(twin.design, neutral_px))
    return twin, np.array(state["deviations"]), state["rounds"]
