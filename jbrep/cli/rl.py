"""Training one agent."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from jbrep import api
from jbrep.cli.base import RESUMES, command, say, tell
from jbrep.cli.signals import stop_signals, stoppable
from jbrep.errors import StoppedError
from jbrep.parameters import DrawnTask
from jbrep.text import terminal_width


@command("rl --task face_direction --algorithm ddpg --encoder dae-8 --out runs/a")
def _rl(task: DrawnTask, out: Path, **options: Annotated[Any, api.train]) -> bool:
    with stop_signals() as received:
        from jbrep.encoders.shipped import source_of
        from jbrep.envs.infos import shares_text
        from jbrep.envs.make import is_one_robot
        from jbrep.rl import files

        with _reported_when_stopped(received, f"; {RESUMES}" if task.reproducible else ""):
            agent = api.train(task, out, stop=lambda: bool(received), **options)
    if agent.record.reason is not None:
        kept, how = files.read_run(out), "remove the folder or choose another --out"
        if kept.reason is None:  # it went on after fewer steps
            how = f"choose another --out: {out} is as it was after {kept.steps:,} steps"
        say(f"the run failed: {agent.record.reason}; see {out / files.RUN}", err=True)
        tell(f"to train it again, {how}", err=True)
        return True
    returns = agent.returns
    shown = f"final return on {agent.record.settings.representation}"
    if shares := shares_text(files.last_infos(files.read_infos(out), files.read_evaluations(out))):
        tell(shares)
    with stoppable("the run itself is finished"):
        from jbrep.play.references import beside, mean_text  # which import scipy.stats

        alone = is_one_robot(task, options.get("threads"))
        compared = None if alone else beside(task, returns)
        tell(f"{shown} {compared or mean_text(task, returns)}")
    tell(f"encoder: {source_of(options.get('encoder', 'full'), task)}; all evaluations:")
    say(str(out / files.EVALUATIONS))
    return False


@command("clone --data data/walk --method td3+bc --out runs/clone")
def _clone(out: Path, **options: Annotated[Any, api.clone]) -> None:
    with stoppable(RESUMES):
        agent = api.clone(out=out, **options)
    assert agent.clone
    say(f"{agent.record.settings.name}: {agent.clone.card(terminal_width())}\n{out}")


@contextmanager
def _reported_when_stopped(received: list[int], more: str) -> Iterator[None]:
    """End the command once a signal has stopped what it trains, as a shell reports it."""
    try:
        yield
    except StoppedError as error:
        say(f"{error}{more}", err=True)
        raise SystemExit(128 + received[0]) from None
