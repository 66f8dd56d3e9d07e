"""How much of its return a policy keeps where the robot isn't the one that it learned on."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

from msgspec import UNSET, Meta

from jbrep.envs.description import changeable, with_domain
from jbrep.envs.domain import NAMES, Domain, read_ranges
from jbrep.envs.task import Id, Task
from jbrep.errors import InputError
from jbrep.play.player import Player
from jbrep.records.document import Document
from jbrep.records.record import Finite, Record
from jbrep.rl.settings import Line
from jbrep.stats.bootstrap import bootstrap
from jbrep.text import interval, interval_of, percentiles

USUAL = (  # what a table has unless it is said
    *("noise=0.03", "noise=0.1", "noise=0.3", "delay=1", "delay=2", "delay=3"),
    *("dropped=0.1", "dropped=0.3", "action_delay=1", "body=0..999"),
    *("friction=0.5..1.5", "mass=0.8..1.2", "push=0.1", "push=0.3"),
)
_UNDISTURBED, _IN_TRAINING = "undisturbed", "as in training"


class Row(Record, frozen=True, kw_only=True):
    """What came of the episodes in one domain."""

    name: Line  # of the domain, as people write it
    domain: Domain | None
    returns: Annotated[tuple[Finite, ...], Meta(min_length=1)]  # of each episode
    median: Finite
    p10: Finite
    p90: Finite
    # the mean return as a share of the undisturbed one, with its 95 % interval over episodes; null
    # where one of either is below 0, so that there are no shares
    share: tuple[Finite | None, Finite | None, Finite | None] | None

    @property
    def cells(self) -> tuple[str, str, str]:
        """The row of a table, see `HEADER`."""
        share = "-" if self.share is None else interval(self.share, ".2f")
        return self.name, interval_of(self.returns), share


HEADER = ("perturbation", "median return [10, 90 %]", "share of the mean [95 %]")


class PerturbationTable(Document, frozen=True, kw_only=True):
    """What a policy returns from the same starts in several domains, the first one undisturbed."""

    format = "jbrep perturbations"
    format_version = 3

    policy: Line
    task: Id  # its name
    representation: Line  # what the policy observes
    step: int | None  # of training, if that isn't over
    rows: tuple[Row, ...]


def read_perturbation(text: str) -> dict[str, str]:
    """The numbers and ranges of a domain as people write it: delay=2 or noise=0.1,delay=1..3."""
    given: dict[str, str] = {}
    for part in text.split(","):
        name, equals, value = part.strip().partition("=")
        if not equals or name in given:
            raise InputError(
                f"--perturb {text} isn't a perturbation: write {NAMES[0]}=0.1 or delay=1..3, "
                f"several at once with commas; there are {', '.join(NAMES)}"
            )
        given[name] = value
    read_ranges(given)
    return given


def domains_of(task: Task, chosen: Sequence[str]) -> tuple[dict[str, Domain | None], list[str]]:
    """The domains of a table's rows by what they are called, and what the robot lacks.

    The first row is undisturbed, the second the task's own domain, if it has one; the others are
    what is chosen, as `read_perturbation` takes it, or the usual ones that there can be.
    """
    wanted = {text: read_perturbation(text) for text in chosen or USUAL}
    known = changeable(task)
    lacking = [name for name in NAMES if name not in known]
    if not chosen:
        wanted = {text: each for text, each in wanted.items() if not set(each) - set(known)}
    rows: dict[str, Domain | None] = {_UNDISTURBED: None}
    if task.domain:
        rows[_IN_TRAINING] = task.domain
    for text, given in wanted.items():
        rows[text] = with_domain(task, given).domain or None
    return rows, lacking


def perturb(
    player: Player,
    domains: Mapping[str, Domain | None],
    episodes: int,
    threads: int | None = None,
    retries: int = 0,
) -> Iterator[Row]:
    """Play the same episodes in one domain after the other; each row as it is finished.

    The first domain is that which the others are shares of.
    """
    first = None
    for name, domain in domains.items():
        task = player.task.replace(domain=domain or UNSET)
        returns = player._replace(task=task).returns(episodes, threads, retries)
        first = returns if first is None else first
        share = None
        if min(first.min(), returns.min()) >= 0 and first.max() > 0:
            share = bootstrap(lambda own, usual: own / usual, returns, first)
        yield Row(
            name=name,
            domain=domain,
            returns=tuple(returns.tolist()),
            share=None if share is None else tuple(share.tolist()),
            **percentiles(returns),
        )
