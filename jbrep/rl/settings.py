"""The settings of runs."""

from typing import Annotated, Literal

from msgspec import Meta

from jbrep.records.record import Record

MAX_STEPS = 10**12  # of training
MAX_EPISODES = 10_000  # of an evaluation

Steps = Annotated[int, Meta(ge=1, le=MAX_STEPS)]
Episodes = Annotated[int, Meta(ge=1, le=MAX_EPISODES)]


class TrainingSettings(Record, frozen=True, kw_only=True):
    """How agents are trained and evaluated: what all runs of a study share."""

    steps: Annotated[Steps, Meta(description="Of training.")] = 100_000
    evaluate_every: Annotated[Steps, Meta(description="In steps of training.")] = 10_000
    evaluation_episodes: Annotated[
        Episodes,
        Meta(
            description="Of the deterministic policy, each time, from starts that training doesn't "
            "use."
        ),
    ] = 10
    final_episodes: Annotated[
        int,
        Meta(
            ge=0,
            le=MAX_EPISODES,
            description="Of the last time.",
            extra={"default": "ten times as many"},
        ),
    ] = 0
    trainer: Annotated[
        Literal["", "cohort", "sb3"],
        Meta(
            title="cohort or sb3",
            description="cohort, which is jbrep's own, or sb3, stable-baselines3 itself.",
            extra={"default": "cohort for ddpg, td3 and sac, sb3 for the others"},
        ),
    ] = ""
    precision: Annotated[
        Literal["float32", "bfloat16"],
        Meta(
            description="Of a cohort's products of matrices: float32, or bfloat16, which some "
            "processors compute several times as fast."
        ),
    ] = "float32"
    device: Annotated[
        Literal["cpu", "cuda", "auto"],
        Meta(description="That a cohort learns on; auto is cuda where there is one."),
    ] = "cpu"
