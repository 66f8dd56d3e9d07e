"""A data set on one screen."""

import numpy as np

from jbrep.dataset.reader import Dataset

_FEATURE = "  {:<28} {:<6} {:>10} {:>10} {:>10} {:>10}   {:<16}"


def card(dataset: Dataset) -> str:
    """What a data set holds, how it was made, its returns and its features' ranges."""
    settings, manifest = dataset.manifest.settings, dataset.manifest
    shards = f"{len(manifest.shards):,} of {settings.num_shards:,} shards"
    size = sum(entry.bytes for entry in manifest.shards) / 1e6
    constants = [f"{name} {value}" for name, value in settings.policy.items() if name != "kind"]
    episodes = dataset.episodes
    lines = {
        "task": f"{settings.task}, {dataset.task.size} features",
        "policy": ", ".join([settings.policy["kind"], *constants]),
        "seed": f"{settings.seed}",
        "rows": f"{len(dataset):,} in {len(episodes['length']):,} episodes",
        "ended early": f"{episodes['diverged'].sum():,} episodes, where the physics diverged",
        "columns": ", ".join(dataset.columns),
        "files": f"{shards}, {size:,.1f} MB" + ("" if manifest.complete else "; unfinished"),
        "made with": ", ".join(f"{name} {v}" for name, v in manifest.versions.items()),
        "fingerprint": manifest.fingerprint,
    }
    if len(episodes["return"]):
        low, median, high = np.percentile(episodes["return"], (10, 50, 90))
        lines["return"] = (
            f"median {median:.1f} [10 % {low:.1f}, 90 % {high:.1f}], "
            f"mean {episodes['return'].mean():.1f}, "
            f"from {episodes['return'].min():.1f} to {episodes['return'].max():.1f}"
        )
    text = [str(dataset.folder), *(f"  {name:<12} {value}" for name, value in lines.items())]
    return "\n".join([*text, "", *_feature_lines(dataset)]) if len(dataset) else "\n".join(text)


def _feature_lines(dataset: Dataset) -> list[str]:
    """Unit, extrema, mean and standard deviation of each feature beside its nominal range."""
    size = dataset.task.size
    low, high = np.full(size, np.inf), np.full(size, -np.inf)
    total, squares = np.zeros(size), np.zeros(size)
    first = dataset["observation"][0].astype(np.float64)
    for chunk in dataset["observation"].chunks():
        shifted = chunk - first  # so that squares don't swamp a small spread
        low = np.minimum(low, chunk.min(axis=0))
        high = np.maximum(high, chunk.max(axis=0))
        total += shifted.sum(axis=0)
        squares += np.square(shifted).sum(axis=0)
    mean = total / len(dataset)
    spread = np.sqrt(np.maximum(squares / len(dataset) - mean**2, 0))
    lines = [_FEATURE.format("feature", "unit", "min", "mean", "max", "std", "nominal")]
    for i, feature in enumerate(dataset.task.features):
        values = (f"{v:.4g}" for v in (low[i], first[i] + mean[i], high[i], spread[i]))
        nominal = f"[{feature.low:.4g}, {feature.high:.4g}]"
        lines.append(_FEATURE.format(feature.name, feature.unit, *values, nominal).rstrip())
    return lines
