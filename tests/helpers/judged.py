"""Made-up evaluations of encoders."""

import numpy as np

from jbrep.evaluate.evaluation import (
    Correlation,
    Diagnostics,
    Dynamics,
    Evaluation,
    IntrinsicDimension,
    JudgedOn,
    LatentUnits,
    Neighbours,
    Prediction,
    Score,
)

NOTHING = Score(None, None, None)


def diagnostics(latent=2, **known):
    """An encoder of which nothing is known but what is given."""
    units = LatentUnits(
        mean=[0.0] * latent,
        variance=[1.0] * latent,
        dead=[],
        saturation=None,
        correlation=np.eye(latent).tolist(),
        participation_ratio=None,
        intrinsic_dimension=IntrinsicDimension(two_nn=None, mle=None),
    )
    nothing = {
        **{"kind": "made-up", "nonlinear_probes": {}, "reconstruction": None, "corruption": None},
        **{"latent_units": units, "probes": {}, "value": None, "action": None, "prediction": {}},
        "neighbours": Neighbours(mse=NOTHING, dimensions={}),
        "correlation": Correlation(mean=NOTHING, dimensions={}, state_dimensions=0),
        "dynamics": Dynamics(linear=NOTHING, persistence=NOTHING, change=NOTHING),
        **{"loses": [], "method": {}},
    }
    return Diagnostics(latent=latent, **{**nothing, **known})


def prediction(mean, **known):
    """What is predicted some steps ahead, without interval."""
    nothing = {"features": {}, "reward": NOTHING, "rewarded": None}
    return Prediction(mean=Score(mean, None, None), **{**nothing, **known})


def evaluation(encoders, task="x"):
    """An evaluation of encoders, by label."""
    rows = {"train_rows": 8, "test_rows": 2, "test_episodes": 1, "constant_features": []}
    data = JudgedOn(task=task, fingerprint="", policy={"kind": "uniform"}, seed=None, **rows)
    seen = dict.fromkeys((name for name in encoders if name != "full"), "maybe")
    return Evaluation(
        data=data, resamples=1000, seen=seen, policy=None, needs={}, encoders=encoders
    )
