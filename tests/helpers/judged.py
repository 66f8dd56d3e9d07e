"""Made-up evaluations of encoders."""

from jbrep.evaluation.evaluation import (
    Diagnostics,
    Evaluation,
    JudgedOn,
    LatentUnits,
    Prediction,
    Score,
)

NOTHING = Score(None, None, None)


def diagnostics(latent=2, **known):
    """An encoder of which nothing is known but what is given."""
    lists = {"mean": [0.0] * latent, "variance": [1.0] * latent, "dead": []}
    nothing = {
        **{"kind": "made-up", "scores": {}, "prediction": {}, "loses": [], "method": {}},
        **{"nonlinear_probes": {}, "reconstruction": None},
        "latent_units": LatentUnits(**lists, participation_ratio=None),
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
