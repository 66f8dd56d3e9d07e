"""What is attacked: every command that makes something, at toy size."""

import os
import shutil
from functools import cached_property
from pathlib import Path

from attacks import Surface, command, digest, forked
from click.testing import CliRunner
from command import in_this_process
from foreign import csv_rows, write_bag, write_csv
from rerun.chunk import RrdReader
from small import brief

from jbrep.cli import main
from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.dataset.formats import export, open_sources
from jbrep.encoders import load
from jbrep.envs import describe
from jbrep.envs.names import environment_versions
from jbrep.reporting.report import MARKDOWN, make_report
from jbrep.reporting.tables import read_tables
from jbrep.rl import Run, Session, train
from jbrep.rl.checkpoint import Checkpoint
from jbrep.rl.files import CHECKPOINT, ENCODER, EVALUATIONS, POLICY, RUN
from jbrep.studies.config import Study
from jbrep.studies.plan import REGISTRATION, Plan, find_committed, registration_in
from jbrep.studies.record import RECORD
from jbrep.studies.runner import run_study
from jbrep.studies.tables import REFERENCE_RETURNS, RETURNS

PENDULUM = describe("Pendulum-v1", episode_steps=20)
environment_versions(PENDULUM)  # or every fork looks through the files of all packages
SHORT = ("--task", "Pendulum-v1", "--episode-steps", 20, "--steps", 40, "--evaluation-episodes", 1)
TINY = Study(
    tasks=("face_direction",),
    algorithms=("a2c-paper",),
    representations=("full",),
    seeds=(0, 1),
    steps=40,
    evaluate_every=40,
    evaluation_episodes=1,
    final_episodes=1,
    episode_steps=20,
)


class Shared:
    """What surfaces read: each is made once in a folder, in peace, when it is first needed."""

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()

    @cached_property
    def data(self):
        collect(brief(), self.folder / "data")
        return Dataset(self.folder / "data")

    @cached_property
    def model(self):
        path = self.folder / "model.onnx"
        command_or_refusal("encoder", "export", "pca-4", *TASK, "--out", path)
        return path

    @cached_property
    def study(self):
        folder = self.folder / "study"
        code, told = forked(_study, folder)
        assert code == 0, told
        return folder

    @property
    def run(self):
        return next(self.study.rglob(POLICY)).parent

    def exported(self, to):
        path = self.folder / f"data.{to}"
        export(self.data, to, path)
        return next(path.rglob("main_data.hdf5")).parent if to == "minari" else path


TASK = ("--task", "face_direction")
_LOG = ("--observations", "pitch,gyro,ticks", "--actions", "u", "--time", "time", "--gap", "0.5")
_JOINTS = ("--observations", "/joint_states.position.*", "--actions", "/arm/command.data")
_BAG = (*_JOINTS, "--rate", "50", "--gap", "0.15")
LOGS = {  # of other tools: what writes them, and what their columns are said to be
    "csv": (lambda folder: write_csv(folder / "walk.csv", csv_rows()), _LOG),
    "mcap": (lambda folder: write_bag(folder / "walk-mcap", "mcap"), _BAG),
}
SMALL = {"net_arch": [4], "num_envs": 1}
CHEAP = {"net_arch": [8], "learning_starts": 8, "batch_size": 8, "buffer_size": 100}


def _study(folder):
    run_study(Plan(TINY, folder), in_this_process, 1)
    make_report(folder)


def command_or_refusal(*arguments):
    """A command in this process, quietly; SystemExit with its line if it refuses."""
    told = CliRunner().invoke(main, [*map(str, arguments)], prog_name="jbrep")
    if told.exception and not isinstance(told.exception, SystemExit):
        raise told.exception
    if told.exit_code:
        raise SystemExit(told.output.rstrip("\n").rpartition("\n")[2])


def _run(algorithm, **settings):
    """A run that writes a checkpoint before every rollout."""
    run = Run.of(task=PENDULUM, algorithm=algorithm, steps=32, **LAST, **settings)

    def act(folder):
        train(run, folder, Session(save_every=0))

    def result(folder):
        return digest(folder / POLICY, folder / EVALUATIONS)

    def files(folder):
        """The checkpoint of a run that is stopped on the way."""
        half = folder / "half"
        if not half.exists():
            asked = iter(range(100))
            try:
                train(run, half, Session(save_every=0, stop=lambda: next(asked) > 1))
            except Exception as error:
                assert type(error).__name__ == "StoppedError"  # noqa: PT017
        return [half / CHECKPOINT]

    def read(folder):
        """What a checkpoint says; it is read whole before training goes on."""
        files(folder)
        found = Checkpoint.read(folder / "half")
        return {name: each.tobytes() for name, each in found.tensors.items()}, found.header

    return Surface(act, result, files, read)


LAST = {"preset": "modern", "evaluation_episodes": 1, "final_episodes": 1, "evaluate_every": 32}


def _import(path, options=()):
    """Of a file or a folder; a damaged one may take anything, or be taken for other data."""

    def act(folder):
        command("data", "import", path, *options, "--out", folder / "it")

    return Surface(act, lambda folder: Dataset(folder / "it").fingerprint)


def _export(to, dataset):
    def act(folder):
        command("data", "export", dataset.folder, "--to", to, "--out", folder / f"it.{to}")

    def result(folder):
        given = folder / f"it.{to}"
        given = next(given.rglob("main_data.hdf5")).parent if to == "minari" else given
        known = [e.observation.tobytes() for e in open_sources([str(given)]).episodes()]
        left = [path.name for path in folder.rglob(".*")]
        return known, left

    return Surface(act, result)


def _encoder_import(model):
    def act(folder):
        command("encoder", "import", model, *TASK, "--out", folder / "it.safetensors")

    def result(folder):
        return load(folder / "it.safetensors").fingerprint

    def files(folder):
        return [folder / "it.safetensors"]

    return Surface(act, result, files, result)


def _encoder_export():
    def act(folder):
        command("encoder", "export", "dae-4", *TASK, "--out", folder / "it.onnx")

    return Surface(act, lambda folder: digest(folder / "it.onnx"))


def _registration():
    def act(folder):
        (folder / "it.toml").write_text(TINY.toml())
        command("study", folder / "it.toml", "--register", "--out", folder / "it")

    def result(folder):
        registered = registration_in(folder / f"it.{REGISTRATION}")
        return registered.study, registered.encoders

    def files(folder):
        return [folder / f"it.{REGISTRATION}"]

    def read(folder):
        return find_committed(folder / "it.toml", TINY)

    return Surface(act, result, files, read)


def _report(study: Path):
    """Of runs; what is damaged are tables alone, as results are passed on."""

    def prepare(folder):
        shutil.copytree(study, folder / "it", ignore=shutil.ignore_patterns("report.html"))

    def act(folder):
        command("report", folder / "it", "--json")

    def result(folder):
        it = folder / "it"
        names = (RETURNS, REFERENCE_RETURNS, RECORD, MARKDOWN)
        return digest(*(it / name for name in names))

    def files(folder):
        alone = folder / "alone"
        if not alone.exists():
            alone.mkdir()
            for name in (RETURNS, REFERENCE_RETURNS, RECORD):
                shutil.copy(folder / "it" / name, alone)
        return [alone / name for name in (RETURNS, REFERENCE_RETURNS, RECORD)]

    def read(folder):
        files(folder)
        tables = read_tables(folder / "alone")
        return tables.raw.returns, tables.raw.references, tables.raw.record.text()

    return Surface(act, result, files, read, prepare)


def _of_a_run(run: Path, line, made, says=digest, reads=(RUN, POLICY, ENCODER)):
    """A command that begins with a run, of which some files are read, and what it makes."""

    def prepare(folder):
        shutil.copytree(run, folder / "run")

    def act(folder):
        os.chdir(folder)  # as what is made tells the paths that it was made from
        command(*line.split())

    def result(folder):
        return says(*sorted(folder.glob(made)))

    def files(folder):
        """Of a copy."""
        if not (folder / "damaged").exists():
            prepare(folder / "damaged")
        return [folder / "damaged" / "run" / name for name in reads]

    def read(folder):
        """What the command makes: whole, or nothing."""
        files(folder)
        os.chdir(folder / "damaged")
        try:
            command_or_refusal(*line.split())
            return result(Path.cwd())
        except SystemExit:
            left = sorted(path.name for path in Path.cwd().iterdir())
            assert left == ["run"], left
            raise
        finally:
            for path in Path.cwd().glob("it*"):
                (shutil.rmtree if path.is_dir() else Path.unlink)(path)

    return Surface(act, result, files, read, prepare)


def _rows(recording):
    """What a recording has, as its rows tell the time at which they were sent."""
    chunks = RrdReader(recording).stream()
    return sorted((each.entity_path, each.num_rows) for each in chunks)


SHORT_RUN = (
    "rl --task face_direction --algorithm a2c --preset paper --episode-steps 20 --steps 40 "
    "--evaluation-episodes 1 --from run --out it"
)
SURFACES = {  # by name, what makes them of `Shared`
    "checkpoints of sac": lambda shared: _run("sac", overrides=CHEAP),
    "checkpoints of ppo": lambda shared: _run(
        "ppo", overrides={**SMALL, "n_steps": 8, "batch_size": 8}
    ),
    **{
        f"import of {to}": lambda shared, to=to: _import(shared.exported(to))
        for to in ("npz", "parquet", "minari")
    },
    **{
        f"import of {to}": lambda shared, write=write, told=told: _import(
            write(shared.folder), told
        )
        for to, (write, told) in LOGS.items()
    },
    **{
        f"export to {to}": lambda shared, to=to: _export(to, shared.data)
        for to in ("npz", "parquet", "minari")
    },
    "encoder import": lambda shared: _encoder_import(shared.model),
    "encoder export": lambda shared: _encoder_export(),
    "registration": lambda shared: _registration(),
    "report": lambda shared: _report(shared.study),
    "rl --from": lambda shared: _of_a_run(shared.run, SHORT_RUN, "it/*.csv", reads=(RUN, POLICY)),
    "inspect": lambda shared: _of_a_run(shared.run, "inspect run --out it.rrd", "it.rrd", _rows),
    "render": lambda shared: _of_a_run(
        shared.run, "render run --size 64x64 --out it.gif", "it.gif"
    ),
}
