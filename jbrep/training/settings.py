"""The settings that several methods have: what each may be, and what it is for."""

import sys
from typing import Annotated, Literal

from msgspec import Meta

from jbrep.coordinates import INGREDIENTS, Ingredient, System
from jbrep.encoders.layers import MAX_UNITS

MAX_HORIZON = 1000  # steps ahead
_MAX_SEED = (1 << 63) - 1  # that torch accepts

Scaling = Annotated[
    Literal["extrema", "nominal", "standard", "robust"],
    Meta(description="What becomes -1 and 1: extrema, nominal (usual ranges), standard or robust."),
]
On = Annotated[
    System,
    Meta(
        description="What is encoded: the observation; angles, the same with each as cosine and "
        "sine; coordinates, without jumps; or symmetry, without what turning the world changes."
    ),
]
LeaveOut = Annotated[
    tuple[Ingredient, ...],
    Meta(description=f"Parts of coordinates to leave out: {', '.join(INGREDIENTS)}."),
]
Clip = Annotated[
    Annotated[float, Meta(ge=1, le=10**6)] | None,
    Meta(description="Limit of scaled values, at least 1."),
]
Latent = Annotated[int, Meta(ge=1, le=MAX_UNITS, description="Latent units l.")]
Names = tuple[Annotated[str, Meta(min_length=1)], ...]
Keep = Annotated[Names, Meta(description="Features, or patterns of them, that skip the encoder.")]
Codes = Annotated[
    Literal["raw", "standard", "white"],
    Meta(
        description="Scale of the latent: raw, as the kind gives it; standard, mean 0 and standard "
        "deviation 1/3 of each unit; or white, uncorrelated as well."
    ),
]
Architecture = Annotated[
    str,
    Meta(
        description="Layers of the network: paper, deep, linear, or sizes of your own, such as "
        "64,64."
    ),
]
Epochs = Annotated[int, Meta(ge=1, le=_MAX_SEED, description="Passes over the data.")]
BatchSize = Annotated[
    Annotated[int, Meta(ge=1, le=_MAX_SEED)] | None,
    Meta(
        description="Rows in a batch; by default 128 to 8192, from the rows, unless the kind has "
        "its own."
    ),
]
LearningRate = Annotated[float, Meta(gt=0, le=1, description="Learning rate of Adam.")]
Seed = Annotated[int, Meta(ge=0, le=_MAX_SEED, description="Random seed.")]
NoiseDeviation = Annotated[
    float, Meta(ge=0, le=sys.float_info.max, description="Standard deviation of the corruption.")
]
Steps = Annotated[tuple[Annotated[int, Meta(ge=1, le=MAX_HORIZON)], ...], Meta(min_length=1)]
Weight = Annotated[float, Meta(ge=0, le=10**6)]  # of a part of a loss
FeatureWeights = Annotated[
    dict[str, Weight],
    Meta(description="Weights of features, or of patterns, in the error; 1 otherwise."),
]
RewardWeight = Annotated[Weight, Meta(description="Weight of the reward.")]
TransitionWeight = Annotated[Weight, Meta(description="Weight of the error of the next latent.")]
