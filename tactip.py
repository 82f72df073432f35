"""The front door: one subcommand for each job, nothing else."""

import sys
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.options import LearningOptions, SearchOptions
from benchmarks.options import ServoOptions as FollowedOptions
from control.options import Options as ServoOptions
from tactip_model.errors import Stopped, TactipError

Range = tuple[float, float]


@dataclass(frozen=True)
class RangeOptions:
    """Low and high of each component. What is not given is the paper's (Table 1) for the task."""

    x_mm: Range | None = None
    """Horizontal, square to the edge, mm."""
    y_mm: Range | None = None
    """Horizontal, along the edge, mm."""
    depth_mm: Range | None = None
    """Depth, negative into the object, mm."""
    roll_deg: Range | None = None
    """Rotation vector about x, degrees."""
    pitch_deg: Range | None = None
    """Rotation vector about y, degrees."""
    yaw_deg: Range | None = None
    """Rotation vector about the normal, degrees."""


@dataclass(frozen=True)
class Make:
    """Make labelled, sheared tactile images with the simulated sensor. Run again, it goes on where it stopped."""

    out: Path
    """Folder of the set; of the sets (OUT/TASK/SPLIT) if task or split is all."""
    task: str = "surface"
    """surface, edge, or all."""
    split: str = "train"
    """train, val, test, or all: independent draws."""
    samples: int = 200
    """Contacts in a set; the paper has 2000."""
    seed: int = 0
    """Seed of the draws."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""
    fidelity: str = "standard"
    """draft, standard or reference (sim/fidelity.py)."""
    design: str = "tactip-127"
    """tactip-127, tactip-331, or a design file (.json) as `tactip calibrate` writes it."""
    symmetric: bool = False
    """Make samples of each contact's turns and mirrors, too: 8 of a contact on the surface, 2 of one on the edge."""
    curvature_per_m: Range = (0.0, 0.0)
    """Both principal curvatures of the surface, 1/m, drawn from LOW to HIGH for each contact; positive bulges out. Not a
    label."""
    renderer: str = "pyrender"
    """pyrender, or raster: the same image without OpenGL."""
    pose: RangeOptions = field(default_factory=RangeOptions)
    """Labelled poses."""
    shear: RangeOptions = field(default_factory=RangeOptions)
    """Unlabelled perturbations."""

    def run(self):
        from sim.crew import worker_count
        from sim.generation import make

        results = make(self._jobs(), worker_count(self.workers))
        failed = 0
        for r in results:
            failed += r["failed"]
            made = f", {r['made']} of them now" if r["made"] else ", complete already"
            print(f"{r['folder']}: {r['kept']} of {r['asked']} samples{made}; {r['failed']} failed")
        made, seconds = sum(r["made"] for r in results), max(r["seconds"] for r in results)
        if made:
            print(f"{made} samples in {seconds:.1f} s: {made / seconds:.2f} samples/s")
        if failed:
            print(f"{failed} contacts failed each try and were left out: meta.json names them and says why")
        return 0

    def _jobs(self):
        from sim.dataset import Configuration
        from sim.fidelity import fidelity_named
        from sim.generation import Job
        from sim.sampling import POSE_RANGES, SHEAR_RANGES, SPLITS
        from sim.stimulus import TASKS
        from tactip_model.errors import choose
        from tactip_model.presets import find_design

        choose("task", self.task, dict.fromkeys([*TASKS, "all"]))
        choose("split", self.split, dict.fromkeys([*SPLITS, "all"]))
        tasks = TASKS if self.task == "all" else (self.task,)
        splits = SPLITS if self.split == "all" else (self.split,)
        several = "all" in (self.task, self.split)
        jobs = []
        for task in tasks:
            for split in splits:
                configuration = Configuration(
                    task=task,
                    split=split,
                    samples=self.samples,
                    seed=self.seed,
                    renderer=self.renderer,
                    design=find_design(self.design),
                    fidelity=fidelity_named(self.fidelity),
                    pose=_with_options(POSE_RANGES[task], self.pose),
                    shear=_with_options(SHEAR_RANGES, self.shear),
                    symmetric=self.symmetric,
                    curvature_per_m=self.curvature_per_m,
                )
                jobs.append(Job(configuration, self.out / task / split if several else self.out))
        return jobs


def _with_options(ranges, options):
    """A configuration (a dataclass) with the fields that options (a dataclass) give put in their place."""
    from dataclasses import replace

    given = {f.name: getattr(options, f.name) for f in fields(options) if getattr(options, f.name) is not None}
    return replace(ranges, **given)


@dataclass(frozen=True)
class Verify:
    """Check that a set is whole: images, rows, pins, checksums, one configuration."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""

    def run(self):
        from sim.dataset import read_meta
        from sim.verification import verify

        problems = verify(self.folder)
        for problem in problems:
            print(f"{self.folder}: {problem}", file=sys.stderr)
        if problems:
            print(f"{self.folder}: {len(problems)} problem(s)", file=sys.stderr)
            return 1
        samples = read_meta(self.folder).get("samples", {})
        print(f"{self.folder}: whole; {samples.get('kept', 'some')} samples, {samples.get('failed', 0)} failed contacts")
        return 0


@dataclass(frozen=True)
class Show:
    """Write a contact sheet of a set: images over their labels (x y depth, roll pitch yaw)."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path = Path("sheet.png")
    """PNG to write."""
    count: int = 24
    """Samples, spread over the set."""
    columns: int = 6
    """Samples in a line."""

    def run(self):
        from sim.sheet import write_sheet

        write_sheet(self.folder, self.out, self.count, self.columns)
        print(f"{self.out} written")
        return 0


@dataclass(frozen=True)
class Record:
    """Play a sample's contact once more, the same, and keep every time step: for `tactip replay`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path
    """Folder of the recording."""
    sample: int = 0
    """Index of the sample."""
    model: str = ""
    """A shipped network or the folder of a training, that says what it feels; the shipped one of task and design, if there
    is one and this is empty; `none` for none."""

    def run(self):
        from sim.contact_recording import record_contact
        from sim.dataset import read_configuration, read_meta

        configuration = read_configuration(read_meta(self.folder), self.folder)
        read = _reader(self.model, configuration.task, configuration.design)
        record, _ = record_contact(self.folder, self.sample, self.out, read)
        print(f"{record['object']}: {record['steps']} steps recorded; see them: tactip replay {self.out}")
        return 0


@dataclass(frozen=True)
class Dataset:
    """Make, verify, show and record data sets."""

    action: Annotated[
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Verify, tyro.conf.subcommand("verify")]
        | Annotated[Show, tyro.conf.subcommand("show")]
        | Annotated[Record, tyro.conf.subcommand("record")],
        tyro.conf.arg(name=""),
    ]

    def run(self):
        return self.action.run()


@dataclass(frozen=True)
class Stability:
    """Map where contacts converge and where they are refused. Run again, it goes on where it stopped."""

    out: Path = Path("docs")
    """Folder for stability.json, stability.md and stability.png."""
    quick: bool = False
    """Every seventh cell: about a minute and a half on two cores."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""

    def run(self):
        from benchmarks.stability import run
        from sim.crew import worker_count

        result = run(self.out, worker_count(self.workers), self.quick)
        print(f"{self.out / 'stability.md'} written")
        return 1 if result["counts"]["wrong"] else 0


@dataclass(frozen=True)
class Calibrate:
    """Fit the sensor to real frames: lens, pins, materials, friction, rig. Run again, it goes on where it stopped."""

    real: tyro.conf.Positional[Path]
    """Folder of the real set: a neutral image init*.png, frames, targets.csv and meta.json (sim/real_set.py)."""
    design: str = "nominal-127"
    """Design to start from: nominal-127, nominal-331, another preset, or a design file (.json)."""
    out: Path = Path("design.json")
    """Design file to write; --design of other commands takes it."""
    report: Path | None = None
    """Folder for the report; the design file's name with _calibration if not given."""
    frames: int = 60
    """Frames to fit, of one half of the set."""
    judged: int = 150
    """Frames to judge, of the other half."""
    seed: int = 0
    """Seed of the draws of frames."""

    def run(self):
        from dataclasses import replace

        from sim.calibration import Settings, calibrate
        from sim.calibration_report import write_report
        from tactip_model.presets import find_design

        if self.out.suffix != ".json":
            raise TactipError(f"the design file {self.out} must end in .json")
        if self.frames < 10 or self.judged < 10:
            raise TactipError(f"{self.frames} frames to fit and {self.judged} to judge: each must be at least 10")
        report = self.report or self.out.with_name(f"{self.out.stem}_calibration")
        report.mkdir(parents=True, exist_ok=True)
        settings = Settings(frames=self.frames, judged=self.judged, seed=self.seed)
        design = replace(find_design(self.design), name=self.out.stem)
        result = calibrate(self.real, design, settings, report / "state.json")
        figures = write_report(result, self.real.resolve().name, settings, self.out, report)
        judged = figures["frames_px"]["share_of_move_found"]
        print(f"judged frames: {judged['rms']:.2f} px rms, median {judged['median']:.2f} px (256 px image)")
        print(f"{self.out} and {report / 'calibration.md'} written")
        return 0


@dataclass(frozen=True)
class NetworkOptions:
    """What is given replaces what the recipe or the configuration has (learning/posenet.py says what each is)."""

    conv_layers: int | None = None
    """Convolutions."""
    filters: int | None = None
    """Filters of the first."""
    widening: float | None = None
    """Filters of each over those of the one before."""
    most_filters: int | None = None
    """... up to so many."""
    blur_px: float | None = None
    """Blur of the image, px."""
    reduce: int | None = None
    """Squares of so many px are averaged."""
    fold: bool | None = None
    """Their pixels become channels instead."""
    halving: str | None = None
    """pool or stride: how a layer halves its image."""
    further: int | None = None
    """Convolutions that follow in each layer."""
    dense_layers: int | None = None
    """Dense layers."""
    units: int | None = None
    """Units of each."""
    activation: str | None = None
    """relu or elu."""
    batch_norm: bool | None = None
    """Batch normalisation."""
    group_norm: int | None = None
    """Group normalisation over so many filters each."""
    dropout: float | None = None
    """Share left out before each dense layer."""
    l1: float | None = None
    """Weight of L1."""
    l2: float | None = None
    """Weight of L2."""
    batch_size: int | None = None
    """Images a step."""


@dataclass(frozen=True)
class TrainOptions:
    """What is given replaces what the recipe or the configuration has (learning/train.py says what each is)."""

    seed: int | None = None
    """Seed of weights, order and dropout."""
    epochs: int | None = None
    """Most epochs."""
    least_steps: int | None = None
    """Steps for which a small set is gone through more often."""
    patience: int | None = None
    """Epochs without a better validation error before the end."""
    rate: float | None = None
    """Learning rate of Adam."""
    muon: float | None = None
    """Learning rate of Muon for the weights between layers; 0 for Adam alone."""
    decay: float | None = None
    """Its decay a step, of the schedule `paper`."""
    schedule: str | None = None
    """paper or cosine."""
    precision: str | None = None
    """float32, bfloat16, or auto."""
    drawn: float | None = None
    """Share of the images drawn anew at every step, under varied optics."""
    optics: float | None = None
    """How far optics are varied for that, 1 for all of their ranges."""


@dataclass(frozen=True)
class Train:
    """Train a network on a data set. Run again, it goes on where it stopped."""

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the training."""
    recipe: str = "laptop"
    """laptop or paper (learning/networks.py)."""
    config: Path | None = None
    """Instead of a recipe: a JSON file, as `tactip tune` writes best.json."""
    device: str = "auto"
    """auto, cpu or cuda."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
    """Changes to the network."""
    training: TrainOptions = field(default_factory=TrainOptions)
    """Changes to the training."""

    def run(self):
        from learning.device import device_named
        from learning.networks import Recipe, read_recipe, recipe_named
        from learning.samples import read_splits
        from learning.train import train

        device_named(self.device)
        given = read_recipe(self.config) if self.config else None
        train_samples, val_samples = read_splits(self.data)
        recipe = given or recipe_named(self.recipe, train_samples.labels.task)
        recipe = Recipe(_with_options(recipe.network, self.network), _with_options(recipe.settings, self.training))
        if recipe.settings.drawn and self.training.drawn is None and not (train_samples.folder / "pins.npz").exists():
            print(f"{train_samples.folder} has no pins: its images are taken as they are, and none is drawn anew")
            recipe = replace(recipe, settings=replace(recipe.settings, drawn=0.0))
        train(train_samples, val_samples, recipe.network, recipe.settings, self.out, self.device)
        print(f"{self.out / 'model.json'} written")
        return 0


@dataclass(frozen=True)
class SpaceOptions:
    """Limits of what is tried. What is not given is the paper's."""

    most_conv_layers: int | None = None
    """Most convolutions."""
    most_dense_layers: int | None = None
    """Most dense layers."""
    most_units: int | None = None
    """Most units of a dense layer."""
    blur_px: float | None = None
    """Blur of the image in every trial, px."""
    reduce: int | None = None
    """Squares of so many px are averaged in every trial: at 2 convolutions multiply a quarter."""


@dataclass(frozen=True)
class Tune:
    """Search for a network by TPE, each trial a training. Run again, it goes on where it stopped."""

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the search."""
    trials: int = 300
    """Trainings in all."""
    startup: int = 50
    """The first so many at random."""
    max_filters: int = 512
    """Most filters of a convolution; a CPU hardly trains more than 64."""
    jobs: int = 1
    """Trainings at a time."""
    cluster: str | None = None
    """Address of a Ray cluster (auto: this machine's; local: this machine alone). Needs the extra `cluster`."""
    seed: int = 0
    """Seed of the suggestions."""
    prune: bool = False
    """End trials that half of those before them had left behind by then."""
    device: str = "auto"
    """auto, cpu or cuda."""
    space: SpaceOptions = field(default_factory=SpaceOptions)
    """Other limits."""
    training: TrainOptions = field(default_factory=TrainOptions)
    """Changes to each training; the paper's otherwise."""

    def run(self):
        from learning.device import device_named
        from learning.space import SearchSpace
        from learning.train import TrainSettings
        from learning.tune import TuneSettings, tune

        device_named(self.device)
        if self.jobs < 1:
            raise TactipError(f"{self.jobs} jobs cannot work: ask for at least 1")
        settings = TuneSettings(
            trials=self.trials,
            startup=self.startup,
            seed=self.seed,
            prune=self.prune,
            space=_with_options(SearchSpace(most_filters=self.max_filters), self.space),
            training=_with_options(TrainSettings(), self.training),
        )
        if self.cluster:
            from learning.cluster import tune_on_cluster

            results = tune_on_cluster(self.data, self.out, settings, self.jobs, self.cluster, self.device)
        else:
            results = tune(self.data, self.out, settings, self.jobs, self.device)
        good = [r for r in results if r["status"] == "ok"]
        print(f"{len(results)} trials, {len(good)} of them ended well: {self.out / 'best.json'} and tune.png written")
        return 0


@dataclass(frozen=True)
class Evaluate:
    """Hold a model against a set that it has not seen: errors by component, label and shear, worst cases, latency."""

    model: Path
    """Folder of a training, or the name of a shipped model."""
    data: Path
    """Folder of a set."""
    out: Path | None = None
    """Folder for evaluation.json, evaluation.md and pictures."""
    json: bool = False
    """Print one JSON object and nothing else."""
    device: str = "cpu"
    """auto, cpu or cuda."""

    def run(self):
        from json import dumps

        from learning.device import device_named
        from learning.evaluate import evaluate
        from learning.evaluation_page import write_evaluation
        from learning.model import find_model
        from learning.samples import read_samples

        model, samples = find_model(self.model, device_named(self.device)), read_samples(self.data)
        evaluation = evaluate(model, samples)
        if self.out:
            write_evaluation(evaluation, samples, model, self.out)
        figures = evaluation.figures
        if self.json:
            print(dumps(figures))
            return 0
        for name, unit in zip(model.labels.names, model.labels.units, strict=True):
            mae, rmse, bias = (figures[key][name] for key in ("mae", "rmse", "bias"))
            print(f"{name}: mean error {mae:.3f} {unit}, rms {rmse:.3f} {unit}, bias {bias:+.3f} {unit}")
        print(f"{figures['samples']} samples; {figures['parameters']} parameters; {figures['latency_ms']:.1f} ms an image")
        if self.out:
            print(f"{self.out / 'evaluation.md'} written")
        return 0


@dataclass(frozen=True)
class Servo(ServoOptions):
    """Follow a surface or an edge by touch, with the soft tip on an arm: recording, score and picture into OUT."""

    json: bool = False
    """Print the score as one JSON object and nothing else."""

    def run(self):
        from json import dumps

        from tqdm import tqdm

        from control.run import FIGURE, SCORE, run

        bars = []

        def progress(step):
            if not bars:  # nothing is shown before there is something to show: an error is one line
                bars.append(tqdm(unit="step", file=sys.stderr, mininterval=0.5 if sys.stderr.isatty() else 15))
            bars[0].set_postfix_str(f"{step.phase}, {1e3 * abs(float(step.sight.label[2])):.1f} mm deep", refresh=False)
            bars[0].update()

        try:
            score = run(self, progress, say=(lambda line: None) if self.json else print)
        finally:
            for bar in bars:
                bar.close()
        if self.json:
            print(dumps(score))
            return 0
        for name, unit in (
            ("depth_mae_mm", "mm"),
            ("lateral_mae_mm", "mm"),
            ("angle_mean_deg", "°"),
            ("angle_p95_deg", "°"),
        ):
            if score[name] is not None:
                print(f"{name}: {score[name]:.3f} {unit}")
        print(f"{score['steps']} steps, {score['contact_losses']} contact losses; {score['stopped_because']}")
        print(f"{self.out / SCORE}{f' and {self.out / FIGURE}' if self.renderer == 'pyrender' else ''} written")
        return 0


@dataclass(frozen=True)
class Replay:
    """Look at a recording again, in a browser, as a film or as a GIF; nothing is simulated anew."""

    run_: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run")]
    """Folder of a servo run."""
    video: Path | None = None
    """Film to write, .mp4."""
    gif: Path | None = None
    """GIF to write, .gif."""
    every: int = 1
    """Steps a picture."""
    rate: int = 25
    """Pictures a second."""
    host: str = "127.0.0.1"
    """Address to serve the page at: this machine alone."""
    port: int = 8080
    """Port, or the next that is free."""

    def run(self):
        from tqdm import tqdm

        from sim.film import pictures
        from sim.recording import read_recording, read_scenery
        from sim.video import write_video

        if self.every < 1 or self.rate < 1:
            raise TactipError(f"--every is {self.every} and --rate {self.rate}: both must be at least 1")
        asked = [(path, ending) for path, ending in ((self.video, ".mp4"), (self.gif, ".gif")) if path is not None]
        for path, ending in asked:
            if path.suffix.lower() != ending:
                raise TactipError(f"the name {path} does not end in {ending}")
        (record, arrays), scenery = read_recording(self.run_), read_scenery(self.run_)
        if not record["complete"]:
            print(f"{self.run_} was not completed: it has {record['steps']} steps", file=sys.stderr)
        count = -(-record["steps"] // self.every)
        for path, _ in asked:
            drawn = pictures(scenery, record, arrays, self.every)
            write_video(path, tqdm(drawn, total=count, unit="picture", file=sys.stderr, disable=not count), self.rate)
            print(f"{path} written")
        return 0 if asked else self._serve(record, arrays, scenery)

    def _serve(self, record, arrays, scenery):
        from sim.viewer import Viewer

        viewer = Viewer(record, arrays, scenery, self.host, self.port)
        print(f"{viewer.address} shows {self.run_}; Ctrl-C ends it", flush=True)
        return _until_stopped(viewer)


@dataclass(frozen=True)
class View:
    """The live scene in a browser: drag the stimulus, or move it by sliders, and see what the tip feels."""

    task: str = "surface"
    """surface or edge, or another stimulus: sphere, point, needle, knife, corner, hole."""
    design: str = "tactip-127"
    """tactip-127, tactip-331, or a design file (.json)."""
    fidelity: str = "standard"
    """draft, standard or reference."""
    model: str = ""
    """A shipped network or the folder of a training; the shipped one of task and design, if there is one and this is
    empty; `none` for none."""
    renderer: str = "pyrender"
    """pyrender, or raster: without OpenGL."""
    host: str = "127.0.0.1"
    """Address to serve the page at: this machine alone."""
    port: int = 8080
    """Port, or the next that is free."""

    def run(self):
        from sim.fidelity import fidelity_named
        from sim.live import Live
        from tactip_model.presets import find_design
        from tactip_model.renderer import renderer_named

        design = find_design(self.design)
        render, read = renderer_named(self.renderer, design), _reader(self.model, self.task, design)
        live = Live(design, self.task, fidelity_named(self.fidelity), render, read, self.host, self.port)
        print(f"{live.address} shows the tip {design.name} on the stimulus {self.task}; Ctrl-C ends it", flush=True)
        return _until_stopped(live)


def _reader(name, task, design):
    """The function of a tactile image to what a network feels (dict by component), or None.

    name: str, as of the option `model`. task: str. design: Design.
    """
    from learning.model import find_model, shipped_models

    chosen = name or f"{task}-{design.name}"
    if name == "none" or not (name or chosen in shipped_models()):
        return None
    model, made = find_model(chosen), design.image.size_px
    if model.size != made:
        raise TactipError(f"the network {chosen} takes images of {model.size} px, and the design makes {made}")
    return lambda image: dict(zip(model.labels.components, model.predict(image[None])[0].tolist(), strict=True))


def _until_stopped(page):
    """Serve a page (Viewer or Live) until Ctrl-C. Returns the exit status."""
    try:
        page.run()
    except KeyboardInterrupt:
        return 0
    finally:
        page.close()


@dataclass(frozen=True)
class Error:
    """Measure errors and costs of contacts over presets and numbers. Run again, it goes on where it stopped."""

    out: Path = Path("docs")
    """Folder for fidelity.json, fidelity.md and fidelity.png."""
    contacts: int = 10
    """Contacts of each training set for the presets."""
    swept: int = 5
    """Contacts of each training set for numbers changed one at a time."""
    redraw: bool = False
    """Only write page and figure anew from fidelity.json."""

    def run(self):
        from benchmarks.error_against_time import Options, run

        run(Options(contacts=self.contacts, swept=self.swept, out=self.out, redraw=self.redraw))
        print(f"{self.out / 'fidelity.md'} written")
        return 0


@dataclass(frozen=True)
class Parts:
    """Measure what each part of the data-set scene costs, and count what it holds."""

    out: Path = Path("docs")
    """Folder for parts.json and parts.md."""
    contacts: int = 6
    """Contacts of each training set."""

    def run(self):
        from benchmarks.scene_parts import Options, run

        run(Options(contacts=self.contacts, out=self.out))
        print(f"{self.out / 'parts.md'} written")
        return 0


class Learning(LearningOptions):
    __doc__ = LearningOptions.__doc__

    def run(self):
        from benchmarks.learned import run

        run(self)
        print(f"{self.out / 'learning.md'} written")
        return 0


class Search(SearchOptions):
    __doc__ = SearchOptions.__doc__

    def run(self):
        from benchmarks.searched import run

        run(self)
        print(f"{self.out / 'search.md'} written")
        return 0


class Followed(FollowedOptions):
    __doc__ = FollowedOptions.__doc__

    def run(self):
        from benchmarks.followed import run

        run(self)
        print(f"{self.out / 'servo.md'} written")
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure the simulation and what is learned: errors, costs, and where they can be trusted."""

    action: Annotated[
        Annotated[Stability, tyro.conf.subcommand("stability")]
        | Annotated[Error, tyro.conf.subcommand("error")]
        | Annotated[Parts, tyro.conf.subcommand("parts")]
        | Annotated[Learning, tyro.conf.subcommand("learning")]
        | Annotated[Search, tyro.conf.subcommand("search")]
        | Annotated[Followed, tyro.conf.subcommand("servo")],
        tyro.conf.arg(name=""),
    ]

    def run(self):
        return self.action.run()


def main(arguments=None):
    """Run the command line. arguments: list of str, the process's own if None. Returns the exit status (int)."""
    about = "A digital twin of the TacTip, a soft optical fingertip."
    try:
        command = tyro.extras.subcommand_cli_from_dict(
            {
                "dataset": Dataset,
                "calibrate": Calibrate,
                "train": Train,
                "tune": Tune,
                "evaluate": Evaluate,
                "servo": Servo,
                "replay": Replay,
                "view": View,
                "bench": Bench,
            },
            args=arguments,
            prog="tactip",
            description=about,
        )
        return command.run()
    except TactipError as error:
        print(f"tactip: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"tactip: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except (Stopped, KeyboardInterrupt) as stopped:
        print(f"tactip: stopped; {stopped or 'nothing was begun'}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
