"""What a user chooses of a data set besides its task: how much of it, and the policy that acts."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal

from msgspec import Meta

from jbrep.errors import InputError
from jbrep.records.record import Record, Sha256, converted

IMPORTED = "imported"  # data that were made elsewhere
MIXTURE = "mixture"  # a policy for each episode, by weights
TRAINED = "trained"  # of a run, kept in a file beside the shards
MAX_LETTERS = 200  # of a text
MAX_ROOT_SEED = 2**31 - 2  # so that an episode's seed has 63 bits

_MAX_CONSTANTS = 1000

_Line = Annotated[str, Meta(max_length=MAX_LETTERS)]
_Number = Annotated[float, Meta(gt=-(10**12), lt=10**12)]
_List = Annotated[tuple[_Number | _Line, ...], Meta(max_length=_MAX_CONSTANTS)]
_Constants = Annotated[Mapping[_Line, _Number | _Line | _List], Meta(max_length=_MAX_CONSTANTS)]
PolicySettings = Mapping[str, Any]
_Kind = Annotated[str, Meta(pattern=r"\A[a-z-]+\Z")]
_Weight = Annotated[float, Meta(gt=0, lt=10**12)]


class CollectSettings(Record, frozen=True, kw_only=True):
    """How much is collected, and how it is stored."""

    steps: Annotated[
        int, Meta(ge=1, le=10**12, description="How many; the last episode is completed.")
    ]
    seed: Annotated[
        int, Meta(ge=0, le=MAX_ROOT_SEED, description="Root of every episode's seed.")
    ] = 0
    shard_episodes: Annotated[
        int,
        Meta(
            ge=1,
            le=1_000_000,
            description="Episodes in a shard.",
            extra={
                "default": "so many that a shard has 100,000 steps in a batch of the Jitterbug, "
                "20,000 in others"
            },
        ),
    ] = 100
    store_state: Annotated[
        bool, Meta(description="Store the Jitterbug's qpos and qvel, for jbrep data derive.")
    ] = False


class _Mixture(Record, frozen=True, kw_only=True):
    """Policies that are no mixtures, each with its weight."""

    kind: Literal["mixture"]
    parts: Annotated[
        tuple[tuple[_Weight, Mapping[str, Any]], ...], Meta(min_length=2, max_length=_MAX_CONSTANTS)
    ]

    def check(self) -> None:
        for _, part in self.parts:
            check_policy(part)
            if part["kind"] == MIXTURE:
                raise InputError("the parts of a mixture must be other policies")


class _Trained(Record, frozen=True, kw_only=True):
    """The policy of a run, in a file beside the shards and nowhere else."""

    kind: Literal["trained"]
    file: Annotated[str, Meta(pattern=r"(?a)\Apolicy-\d{1,3}\.safetensors\Z")]
    sha256: Sha256
    run: _Line
    step: Annotated[int, Meta(ge=0, lt=10**12)]


def check_policy(policy: Mapping[str, Any]) -> None:
    """Make sure that a policy is a kind and constants that fit it: numbers and short text."""
    kind = policy.get("kind")
    converted(kind, _Kind, "the kind of a policy")
    converted(policy, {MIXTURE: _Mixture, TRAINED: _Trained}.get(str(kind), _Constants), "policy")
    if not all(text.isprintable() for text in _texts([*policy.items()])):
        raise InputError("the policy has text that can't be printed")


def _texts(values: Iterable[Any]) -> Iterator[str]:
    for value in values:
        if isinstance(value, str):
            yield value
        elif isinstance(value, list | tuple):
            yield from _texts(value)


def parts_of(policy: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The policies of a mixture, or else the policy itself."""
    yield from (part for _, part in policy["parts"]) if policy["kind"] == MIXTURE else (policy,)


def policy_text(policy: Mapping[str, Any]) -> str:
    """A policy's kind and constants for people: "constant, drive 0.5"."""
    if policy["kind"] == MIXTURE:
        return "; ".join(f"{weight:.3g} of {policy_text(part)}" for weight, part in policy["parts"])
    hidden = ("kind", "file", "sha256")  # the last two, of a trained policy, say nothing to people
    constants = (f"{name} {value}" for name, value in policy.items() if name not in hidden)
    return ", ".join([policy["kind"], *constants])
