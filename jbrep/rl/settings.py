"""The settings of runs, and the names of what they choose from."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from jbrep.errors import InputError
from jbrep.records.record import Record, pattern

BC: Final = "bc"  # behaviour cloning
MAX_STEPS = 10**12  # of training
MAX_EPISODES = 10_000  # of an evaluation

MAX_SEED = (1 << 31) - 1
MAX_LINE = 1000  # letters
MAX_NAME = 100  # letters of a learner's name

_LETTERS = "letters, digits, '_', '-' and '.'"
Seed = Annotated[int, Meta(ge=0, le=MAX_SEED)]
Name = Annotated[str, pattern(r"\A[\w.-]{1,100}\Z", f"1 to 100 {_LETTERS}")]
LearnerName = Annotated[
    str,
    pattern(
        rf"\A(?=.*[^.])[\w.+=-]{{1,{MAX_NAME}}}\Z",
        f"1 to {MAX_NAME} {_LETTERS}, '+' and '=', not only dots",
    ),
]
Line = Annotated[  # nothing in it controls a terminal
    str,
    pattern(
        rf"\A[^\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f]{{0,{MAX_LINE}}}\Z",
        f"a line of up to {MAX_LINE} letters",
    ),
]
Steps = Annotated[int, Meta(ge=1, le=MAX_STEPS)]
Episodes = Annotated[int, Meta(ge=1, le=MAX_EPISODES)]


class CloneSettings(Record, frozen=True, kw_only=True):
    """How a policy is learned from a data set alone."""

    method: Annotated[
        Literal["bc", "td3+bc"],
        Meta(description="Behaviour cloning; or TD3+BC, offline RL, which needs rewards."),
    ] = BC
    loss: Annotated[
        Literal["squared", "gaussian"],
        Meta(description="Cloning: squared error, or a Gaussian's negative log-likelihood."),
    ] = "squared"
    chunk: Annotated[
        int,
        Meta(
            ge=1,
            le=1000,
            description="Cloning: actions that are predicted at once, and played before the policy "
            "observes again.",
        ),
    ] = 1
    patience: Annotated[
        int, Meta(ge=1, description="Cloning: epochs without a lower held-out loss that end it.")
    ] = 10
    alpha: Annotated[
        float, Meta(gt=0, le=10**6, description="TD3+BC: weight of Q in the actor's loss.")
    ] = 2.5

    def check(self) -> None:
        of_cloning = {"loss": "squared", "chunk": 1, "patience": 10}
        for name, usual in ({"alpha": 2.5} if self.method == BC else of_cloning).items():
            if (given := getattr(self, name)) != usual:
                raise InputError(f"{name} is {given}: with {self.method} leave it out")


class TrainingSettings(Record, frozen=True, kw_only=True):
    """How agents are trained and evaluated: what all runs of a study share."""

    steps: Annotated[Steps, Meta(description="Control steps of training, over all robots.")] = (
        1_000_000
    )
    evaluate_every: Annotated[
        int,
        Meta(
            ge=0,
            le=MAX_STEPS,
            description="Control steps of training between evaluations.",
            extra={"default": "a tenth of all, at least 10,000"},
        ),
    ] = 0
    evaluation_episodes: Annotated[
        Episodes,
        Meta(
            description="Episodes of each evaluation of the deterministic policy, from starts that "
            "training doesn't use."
        ),
    ] = 5
    final_episodes: Annotated[
        int,
        Meta(
            ge=0,
            le=MAX_EPISODES,
            description="Episodes of the last evaluation, after training.",
            extra={"default": "10 x evaluation_episodes"},
        ),
    ] = 0
    device: Annotated[
        Literal["cpu", "cuda", "auto"],
        Meta(description="Device for gradient steps; auto is cuda where there is one."),
    ] = "cpu"

    def check(self) -> None:
        if 0 < self.final_episodes < self.evaluation_episodes:
            raise InputError(
                f"final_episodes is {self.final_episodes}: it must be as many as "
                f"evaluation_episodes, {self.evaluation_episodes}, or more"
            )

    @property
    def training_settings(self) -> "TrainingSettings":
        """These settings, without those that a subclass adds."""
        own = TrainingSettings.__struct_fields__
        return TrainingSettings(**{name: getattr(self, name) for name in own})
