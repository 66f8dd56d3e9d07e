"""One run in its folder: trained by stable-baselines3, from its start or from its checkpoint."""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import data_to_json

from jbrep.encoders import Encoder, save
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.environments import (
    EnvironmentFailedError,
    Environments,
    NonFiniteActionError,
    envs_at_once,
)
from jbrep.envs.infos import by_name
from jbrep.envs.names import environment_versions
from jbrep.errors import InputError, StoppedError
from jbrep.machine import cpu
from jbrep.records.commit import commits
from jbrep.records.storage import exclusive, exists, make_folder, read_file, write_whole
from jbrep.records.tables import write_csv, write_rows
from jbrep.rl import files
from jbrep.rl.agent import (
    acting,
    evaluate,
    make_agent,
    make_env,
    restore_statistics,
    statistics_of,
    training_seed,
    unchecked_distributions,
)
from jbrep.rl.checkpoint import Checkpoint, Saver, Standing, standing, vec_env
from jbrep.rl.history import ControlStepsLogger, History, Scalars
from jbrep.rl.policy import Trained, fill_whole, pack_whole
from jbrep.rl.policy_file import read
from jbrep.rl.run import Run
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_LINE
from jbrep.text import printable
from jbrep.training.trainer import single_thread

_STATISTICS = "observation_statistics.safetensors"  # by which an agent normalises what it sees
_OF_TRAINING = {
    "action_noise",  # which may be jbrep's own
    "replay_buffer_class",  # `load` finds the one for n_steps, and warns of one that is given
}
_OF_THIS_PROCESS = {  # wall times, and where the environment was: `load` starts with defaults
    "_last_episode_starts",
    "_current_progress_remaining",
    "_last_obs",
    "_last_original_obs",
    "_num_timesteps_at_start",
    "ep_info_buffer",
    "ep_success_buffer",
    "start_time",
}
_PACKAGES = ("jbrep", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")


class DivergedError(ArithmeticError):
    """A loss or a weight of the policy is NaN or infinite: training can't continue."""


class Session(NamedTuple):
    """What goes on around training."""

    # called with what a run has recorded and its steps so far
    watch: Callable[[History, int], None] = lambda history, step: None
    save_every: float = 60  # seconds between checkpoints, at least
    # asked before each rollout; once it is true, a checkpoint is written and training ends
    stop: Callable[[], bool] = lambda: False
    # whether a run that has ended keeps a checkpoint, from which it can go on
    keep_checkpoint: bool = False
    threads: int = 1  # that step environments
    retries: int = 0  # how often in a row an environment that fails is made anew


_ALONE = Session()


def train(
    run: Run, folder: Path, session: Session = _ALONE, encoder: BaseEncoder | None = None
) -> files.RunRecord:
    """Train an agent and write its folder, unless the run has ended already.

    A run that was killed or stopped resumes from its checkpoint, to the same bits; a StoppedError
    says that the session's `stop` was true. The encoder is what `run.find_encoder` returns.
    Of a run that went on with more steps and failed, the files are those of the steps before.
    """
    encoder = encoder or run.find_encoder()
    if ended := standing_of(run, folder, encoder).ended:
        return ended
    make_folder(folder, files.OWN)
    with exclusive(folder), single_thread():
        now = standing_of(run, folder, encoder)  # another process may have trained it meanwhile
        if now.ended:
            return now.ended
        record = _train(_Job(run, folder, session, encoder, now.settings), now.resumes)
        is_over = not session.keep_checkpoint or record.status == files.FAILED
        # else that of fewer steps has its checkpoint
        if is_over and files.read_run(folder) == record:
            drop_checkpoint(folder)
        return record


def standing_of(run: Run, folder: Path, encoder: BaseEncoder | None = None) -> Standing:
    """How far a run has come in a folder; see `standing`."""
    settings = run.settings(encoder or run.find_encoder())
    return standing(folder, settings, versions_of(run), is_open=not run.evaluate_every)


def drop_checkpoint(folder: Path) -> None:
    """Remove the checkpoint of a run that has ended, and not gone on since."""
    (folder / files.CHECKPOINT).unlink(missing_ok=True)


def versions_of(run: Run) -> dict[str, str]:
    """The versions of packages that, with the settings, decide every number of a run."""
    return environment_versions(run.task) | packages()


def packages() -> dict[str, str]:
    """The versions of what every run is made with."""
    return {name: version(name) for name in _PACKAGES}


@dataclass(frozen=True)
class _Job:
    run: Run
    folder: Path
    session: Session
    encoder: BaseEncoder
    settings: RunSettings


def _train(job: _Job, resumes: bool) -> files.RunRecord:
    checkpoint = Checkpoint.read(job.folder) if resumes else None
    history = checkpoint.header.history if checkpoint else History()
    if isinstance(job.encoder, Encoder):
        save(job.encoder, job.folder / files.ENCODER)
    with _agent(job) as agent:
        if job.settings.begin_from:
            _begin(agent, job, is_new=not resumes)
        scalars = Scalars(job.folder / "tensorboard", history.first_step)
        agent.set_logger(ControlStepsLogger(job.settings, scalars))
        with closing(_Progress(job, history, checkpoint)) as progress:
            failed = _learn(agent, job.settings.agent_steps, progress)
        return _end(agent, job, history, failed)


@contextmanager
def _agent(job: _Job) -> Iterator[BaseAlgorithm]:
    settings, seed, session = job.settings, training_seed(job.run.seed), job.session
    chosen, steps = settings.hyperparameters, settings.episode_steps
    made = make_env(job.run.task, chosen, seed, job.encoder, session.threads, session.retries)
    with closing(made) as env:
        agent = make_agent(settings.algorithm, chosen, env, settings.seed, steps, settings.device)
        env.seed(seed)  # stable-baselines3 has given it the agent's
        yield agent


def _begin(agent: BaseAlgorithm, job: _Job, is_new: bool) -> None:
    """Give an agent the policy of the run that it begins from, of which its folder has a copy."""
    path, sha256 = job.folder / files.BEGINNING, job.settings.begin_from
    assert sha256 is not None
    if is_new:
        source = read(Path(job.run.begin_from) / files.POLICY, sha256).path
        write_whole(path, read_file(source))
    policy = read(path, sha256)
    fill_whole(policy, agent.policy)
    restore_statistics(agent, policy.tensors)


def _learn(agent: BaseAlgorithm, steps: int, progress: BaseCallback) -> Exception | None:
    try:
        with unchecked_distributions():
            agent.learn(steps, callback=progress)
    except (DivergedError, EnvironmentFailedError) as error:
        return error
    except NonFiniteActionError:
        return DivergedError("the policy's actions are not finite")
    finally:
        agent.logger.close()
    return None


class _Progress(BaseCallback):
    """Records an agent's training, evaluates its policy, and keeps its checkpoint.

    The policy is evaluated before the first step, after the last, and at intervals in between.
    Checkpoints are written between rollouts, where an agent's state is complete; then a session
    that is to stop raises StoppedError.
    """

    def __init__(self, job: _Job, history: History, checkpoint: Checkpoint | None):
        super().__init__()
        self._job, self._history, self._settings = job, history, job.settings
        self._checkpoint = checkpoint
        self._saver = Saver(job.folder, job.settings, versions_of(job.run), job.session.save_every)
        self._envs: Environments | None = None  # of evaluations

    def close(self) -> None:
        """Free what the evaluations hold."""
        if self._envs:
            self._envs.close()

    def _on_training_start(self) -> None:
        run, session = self._job.run, self._job.session
        episodes = run.evaluation_episodes
        if run.one_robot:
            self._envs = vec_env(self.model).envs
        else:
            threads = min(session.threads, episodes)
            self._envs = envs_at_once(run.task, episodes, threads, session.retries)
        if self._checkpoint:
            self._checkpoint.restore(self.model)
            self._checkpoint = None  # a replay buffer can be large

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if not self._history.evaluations:
            self._evaluate(self.model._last_obs)
        self._tell()
        is_stopping = self._job.session.stop()
        if is_stopping or self._saver.is_due:
            self._saver.write(self.model, self._history)
        if is_stopping:
            raise StoppedError(self._step)

    def _on_step(self) -> bool:
        ended = np.flatnonzero(self.locals["dones"]).tolist()
        for index in ended:
            info = self.locals["infos"][index]
            total, length = float(info["episode"]["r"]), info["control_steps"]
            row = files.Episode(self._step, index, total, length, info.get("non_finite", False))
            self._history.episodes.append(row)
        if self._is_evaluation_due(bool(ended)):
            self._evaluate(self.locals["new_obs"])
        return True

    def _is_evaluation_due(self, has_ended: bool) -> bool:
        """Whether to evaluate now; with one robot, once an episode of training has ended."""
        step, keeps = self._step, self._job.session.keep_checkpoint
        if not self._job.run.one_robot:
            return self._settings.is_evaluation_due(step, keeps)
        every, last = self._settings.evaluate_every, self._history.evaluations[-1].step
        is_final = step >= self._settings.steps and not keeps
        return has_ended and not is_final and step // every > last // every

    def _evaluate(self, observed: Any) -> None:
        """Evaluate, with one robot between episodes: the next one begins once more.

        What was observed, (1, l), becomes its first observation as the agent is to see it.
        """
        self._play(self._settings.evaluation_episodes)
        if self._job.run.one_robot:
            first: Any = vec_env(self.model).restart()
            if normalizer := self.model.get_vec_normalize_env():
                normalizer.old_obs = first
                if observed is self.model._last_obs:  # else the transition isn't stored yet
                    vars(self.model)["_last_original_obs"] = first.copy()
                first = normalizer.normalize_obs(first)
            observed[:] = first

    def _play(self, episodes: int) -> None:
        assert self._envs is not None
        outcome = evaluate(self.model, self._envs, self._job.encoder, episodes)
        logger = self.model.logger
        self._history.add(self._step, outcome)
        logger.record("evaluation/mean_return", self._history.last_mean)
        for name, values in by_name(outcome.numbers).items():
            logger.record(f"evaluation/{name}", fmean(values))
        logger.dump(self.model.num_timesteps)

    def _on_training_end(self) -> None:
        check_finite(self.model)
        self._tell()  # the last evaluation can take minutes
        if self._job.session.keep_checkpoint:
            self._saver.write(self.model, self._history)
        self._history.drop_from(self._settings.steps)  # an evaluation of a run that is kept
        self._play(self._settings.final_episodes)
        self._tell()

    def _tell(self) -> None:
        self._job.session.watch(self._history, self._step)

    @property
    def _step(self) -> int:
        return self._settings.control_steps(self.model.num_timesteps)


def check_finite(agent: BaseAlgorithm) -> None:
    """Check the last losses and the policy's weights: a DivergedError if one isn't finite."""
    for name, value in agent.logger.name_to_value.items():
        if name.endswith("loss") and not np.isfinite(value):
            raise DivergedError(f"{name} is {value}")
    if not all(bool(torch.isfinite(p.sum())) for p in acting(agent.policy).parameters()):
        raise DivergedError("the policy's weights are not finite")


def _end(
    agent: BaseAlgorithm, job: _Job, history: History, failed: Exception | None
) -> files.RunRecord:
    """Write the run's files; the policy of a run that failed isn't kept.

    Where a run went on after fewer steps and failed, what it had left by then stays.
    """
    folder, settings = job.folder, job.settings
    keeps = failed is not None and exists(folder / files.RUN)
    goes_on = job.session.keep_checkpoint and exists(folder / files.CHECKPOINT) and not keeps
    if isinstance(failed, EnvironmentFailedError) and goes_on:
        raise InputError(
            f"{failed}; the run in {folder} has a checkpoint: the same command goes on from it if "
            "the environment is reproducible, and its policy can be played and exported"
        ) from failed
    policy, tables = b"", dict[str, str]()
    if not failed:
        trained = Trained(
            agent.policy, job.run.task, job.encoder, settings, statistics=statistics_of(agent)
        )
        policy = pack_whole(trained)
    if keeps:
        tables |= files.read_run(folder).tables
    else:
        (folder / files.RUN).unlink(missing_ok=True)  # of fewer steps, before its files change
        tables |= write_tables(folder, history)
        if policy:
            write_whole(folder / files.POLICY, policy)
            write_whole(folder / files.POLICY_ZIP, policy_zip(agent))
    steps = settings.control_steps(agent.num_timesteps)
    record = files.RunRecord(
        status=files.FAILED if failed else files.FINISHED,
        reason=f"after {steps:,} steps: {printable(str(failed))[: MAX_LINE // 2]}"
        if failed
        else None,
        settings=settings,
        latent_size=job.encoder.latent_size,
        steps=steps,
        seconds=history.seconds,
        versions=versions_of(job.run),
        commits=commits(),
        cpu=cpu(),
        tables=tables,
        policy_sha256=hashlib.sha256(policy).hexdigest() if policy else None,
    )
    if not keeps:
        record.write(folder / files.RUN)  # last: the run has ended where it exists
    return record


def write_tables(folder: Path, history: History) -> dict[str, str]:
    """Write the tables of a run; their SHA-256 by name."""
    tables = {
        files.EPISODES: write_rows(folder / files.EPISODES, history.episodes, files.Episode),
        files.EVALUATIONS: write_rows(
            folder / files.EVALUATIONS, history.evaluations, files.Evaluation
        ),
    }
    if history.infos:
        tables[files.INFOS] = write_csv(folder / files.INFOS, files.Info._fields, history.infos)
    return tables


def policy_zip(agent: BaseAlgorithm) -> bytes:
    """A zip file that the algorithm's `load` takes, as its `save` writes it.

    Unlike there, members carry a fixed date, whatever the clock says, and nothing in them depends
    on the process or the machine. Statistics by which the agent normalises what it observes are a
    member that `load` leaves alone.
    """
    names, variables = agent._get_torch_save_params()
    left_out = {*agent._excluded_save_params(), *_OF_THIS_PROCESS, *_OF_TRAINING}
    left_out |= {name.partition(".")[0] for name in (*names, *variables)}
    data = {name: value for name, value in vars(agent).items() if name not in left_out}
    statistics = statistics_of(agent)
    members: dict[str, str | bytes] = {
        "data": _to_json(data),
        "pytorch_variables.pth": _to_bytes({name: getattr(agent, name) for name in variables}),
        **{f"{name}.pth": _to_bytes(state) for name, state in agent.get_parameters().items()},
        "_stable_baselines3_version": stable_baselines3.__version__,
        **({_STATISTICS: safetensors.numpy.save(statistics.tensors)} if statistics else {}),
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, member in members.items():
            file.writestr(zipfile.ZipInfo(name), member)  # dated 1980, the format's first year
    return content.getvalue()


def _to_json(data: dict[str, Any]) -> str:
    """stable-baselines3's JSON without its notes for human readers, which hold addresses."""
    stated = json.loads(data_to_json(data))
    for name, value in stated.items():
        if isinstance(value, dict) and ":serialized:" in value:
            stated[name] = {key: value[key] for key in (":type:", ":serialized:")}
    return json.dumps(stated, indent=4)


def _to_bytes(tensors: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    torch.save(tensors, content)
    return content.getvalue()
