"""A data set on one screen, or as JSON."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jbrep.dataset.scaling import extrema, mean_and_std
from jbrep.dataset.settings import policy_text
from jbrep.envs.task import Task
from jbrep.text import Table, counted, facts, html, number

if TYPE_CHECKING:
    from jbrep.dataset.reader import Dataset

_HEADER = ("feature", "unit", "min", "mean", "max", "std", "usual range")


def describe(dataset: "Dataset") -> dict[str, Any]:
    """What a data set holds, how it was made, its returns and the ranges of its features.

    Returns:
        Plain values, as JSON takes them; numbers that aren't finite are None.
    """
    manifest, episodes = dataset.manifest, dataset.episodes
    return {
        "folder": str(dataset.folder),
        **manifest.settings.as_json(),
        "rows": len(dataset),
        "episodes": len(episodes["length"]),
        "terminated": int(episodes["terminated"].sum()),
        "steps_per_episode": _spread(episodes["length"]),
        "return": _spread(episodes.get("return", ())),
        "columns": list(dataset.columns),
        "shards": len(manifest.shards),
        "complete": manifest.complete,
        "bytes": sum(entry.bytes for entry in manifest.shards),
        "versions": dict(manifest.versions),
        "fingerprint": manifest.fingerprint,
        "features": _features(dataset) if len(dataset) else [],
    }


def card(dataset: "Dataset", width: int = 80) -> str:
    """`describe` as text of at most `width` columns."""
    about = describe(dataset)
    parts = [f"{dataset.folder}\n{facts(_facts(dataset, about), width)}"]
    if about["features"]:
        parts.append(_table(about).text(width))
    return "\n\n".join(parts)


def card_html(dataset: "Dataset") -> str:
    """`describe` for a notebook."""
    about = describe(dataset)
    told = Table(str(dataset.folder), ("", ""), [*_facts(dataset, about).items()])
    return html(told, *([_table(about)] if about["features"] else ()))


def _table(about: Mapping[str, Any]) -> Table:
    """The features and their ranges."""
    return Table("", _HEADER, [_cells(each) for each in about["features"]])


def _facts(dataset: "Dataset", about: Mapping[str, Any]) -> dict[str, str]:
    """What is known of the whole."""
    policy, returns = about["policy"], about["return"]
    named = {
        "task": _task_line(dataset.task),
        "policy": policy_text(policy),
        "seed": "-" if dataset.manifest.settings.is_imported else f"{about['seed']}",
        "rows": f"{about['rows']:,}",
        "episodes": _episodes_line(about),
        "columns": ", ".join(about["columns"]),
        "files": f"{counted(about['shards'], 'shard')}, {about['bytes'] / 1e6:,.1f} MB"
        + ("" if about["complete"] else f"; unfinished, {about['steps']:,} rows were asked for"),
        "made with": ", ".join(f"{name} {version}" for name, version in about["versions"].items()),
        "fingerprint": about["fingerprint"],
    }
    if returns:
        of = {name: number(value, ".1f") for name, value in returns.items()}
        named["return"] = (
            f"median {of['median']} [10 % {of['p10']}, 90 % {of['p90']}], mean {of['mean']}, "
            f"from {of['min']} to {of['max']}"
        )
    if code := dataset.manifest.settings.reward:
        named["reward"] = f"by {code}"
    if dataset.manifest.settings.unrewarded:
        named["return"] = "not known: the data have no rewards"
    if dataset.manifest.settings.is_imported:
        named["note"] = "the data were imported: no episode can be simulated again"
    elif not dataset.task.reproducible:
        named["note"] = "the environment is not reproducible: no episode can be simulated again"
    return named


def _task_line(task: Task) -> str:
    parts = [task.name, counted(task.size, "feature"), counted(task.action_size, "action")]
    return ", ".join([*parts, *task.given_arguments])


def _episodes_line(about: Mapping[str, Any]) -> str:
    line = f"{about['episodes']:,}"
    if lengths := about["steps_per_episode"]:
        low, high = lengths["min"], lengths["max"]
        line += f" of {low:,.0f}" + (f" to {high:,.0f} steps" if low != high else " steps")
    ended = about["terminated"]
    return f"{line}, {ended:,} terminated by a state" if ended else line


def _cells(feature: Mapping[str, Any]) -> tuple[str, ...]:
    values = [number(feature[name], ".4g") for name in _HEADER[2:6]]
    low, high = feature["nominal"]
    usual = "-" if low is None else f"[{number(low, '.4g')}, {number(high, '.4g')}]"
    return (feature["feature"], feature["unit"], *values, usual)


def _spread(values: Any) -> dict[str, float | None]:
    """Median, 10 % and 90 % quantiles, mean and extrema over the episodes, if there are any."""
    if not len(values):
        return {}
    median, p10, p90 = np.percentile(values, (50, 10, 90))
    named = {"median": median, "p10": p10, "p90": p90, "mean": values.mean()}
    named |= {"min": values.min(), "max": values.max()}
    return {name: _finite(value) for name, value in named.items()}


def _features(dataset: "Dataset") -> list[dict[str, Any]]:
    """Unit, extrema, mean and standard deviation of each feature, and its usual range."""
    column = dataset["observation"]
    (low, high), (mean, std) = extrema(column.chunks()), mean_and_std(column.chunks())
    return [
        {
            "feature": feature.name,
            "unit": feature.unit,
            **{
                name: _finite(values[i])
                for name, values in zip(_HEADER[2:6], (low, mean, high, std), strict=True)
            },
            "nominal": [feature.low, feature.high],
        }
        for i, feature in enumerate(dataset.task.features)
    ]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
