"""What a user chooses of a data set besides its task: how much of it, and the policy that acts."""

from collections.abc import Mapping
from typing import Annotated, Any

from msgspec import Meta

IMPORTED = "imported"  # data that were made elsewhere
MIXTURE = "mixture"  # a policy for each episode, by weights
TRAINED = "trained"  # of a run, kept in a file beside the shards
SHARD_ROWS = 20_000  # of a usual shard
MOST_SHARDS = 5_000  # of data that can't be collected again
MAX_LETTERS = 200  # of a text
MAX_ROOT_SEED = 2**31 - 2  # so that an episode's seed has 63 bits

PolicySettings = Mapping[str, Any]  # a kind and its constants


Steps = Annotated[
    int, Meta(ge=1, le=10**12, description="Steps to collect; the last episode is completed.")
]
RootSeed = Annotated[int, Meta(ge=0, le=MAX_ROOT_SEED, description="Root of every episode's seed.")]
ShardEpisodes = Annotated[
    int,
    Meta(
        ge=1,
        le=1_000_000,
        description="Episodes in a shard.",
        extra={"default": "enough for 20,000 steps, or 100,000 in a batch of the Jitterbug"},
    ),
]
StoreState = Annotated[bool, Meta(description="Store the Jitterbug's qpos and qvel, too.")]


def parts_of(policy: PolicySettings) -> list[PolicySettings]:
    """The policies of a mixture, or else the policy itself."""
    return [part for _, part in policy["parts"]] if policy["kind"] == MIXTURE else [policy]


def policy_text(policy: PolicySettings) -> str:
    """A policy's kind and constants for people: "constant, drive 0.5"."""
    if policy["kind"] == MIXTURE:
        return "; ".join(f"{weight:.3g} of {policy_text(part)}" for weight, part in policy["parts"])
    hidden = ("kind", "file", "sha256")  # the last two, of a trained policy, say nothing to people
    constants = (f"{name} {value}" for name, value in policy.items() if name not in hidden)
    return ", ".join([policy["kind"], *constants])
