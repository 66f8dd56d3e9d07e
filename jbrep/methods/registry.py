"""The methods that make encoders, and how names say which."""

from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Any, get_args

from msgspec.structs import asdict

from jbrep.coordinates import System
from jbrep.dataset.scaling import SCALINGS
from jbrep.encoders.header import EncoderName, of_seed
from jbrep.errors import InputError, choose
from jbrep.methods.kinds import KINDS
from jbrep.training.method import Method

METHODS: dict[str, type[Method]] = {kind: resolve_name(path) for kind, path in KINDS.items()}
_WORDS: dict[str, tuple[str, Any]] = {  # in names, of settings that aren't the usual ones
    **{name: ("scaling", name) for name in SCALINGS},
    **{system: ("on", system) for system in get_args(System)},
    "raw": ("codes", "raw"),
    "unit": ("codes", "standard"),
    "white": ("codes", "white"),
}
_EXAMPLES = (
    "it must be full, coordinates, symmetry, or a method and a latent size, as in dae-8 or "
    "dae-deep-8"
)


def get_method(name: str) -> type[Method]:
    """The method of that name."""
    return choose(name, METHODS, "kind")


def with_preset(kind: str, preset: str | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a method, beside those of one of its presets, if there is one."""
    method = get_method(kind)
    if preset is None:
        return dict(settings)
    if not method.presets:
        raise InputError(f"{kind} has no presets: leave out `preset`")
    return {**choose(preset, method.presets, f"preset of {kind}"), **settings}


def named_settings(
    kind: str, latents: Sequence[Any], seeds: int | None, name: str | None, settings: dict[str, Any]
) -> list[tuple[str | None, dict[str, Any]]]:
    """Names and settings of encoders, one for each latent size and seed, 0 to n - 1.

    A name is None where neither the user nor a seed determines it: data may add to it. `latents` is
    empty for a kind without sizes.
    """
    method = get_method(kind)
    if name and len(latents) > 1:
        raise InputError("one `name` is for one latent size: give each its own")
    per_size = [{**settings, "latent": size} for size in latents] or [settings]
    usual = [name_of(method.of(each)) for each in per_size]  # a mistake shows before data are read
    if seeds is None:
        return [(name, each) for each in per_size]
    if not method.takes("seed"):
        raise InputError(f"{kind} has no seed, so all its encoders are the same: leave out `seeds`")
    if "seed" in settings:
        raise InputError("--seed is for one encoder: leave it out, or `seeds`")
    return [
        (of_seed(name or default, seed), {**each, "seed": seed})
        for default, each in zip(usual, per_size, strict=True)
        for seed in range(seeds)
    ]


def name_of(method: Method) -> str:
    """What an encoder is called: method, what is unusual about it, and latent size."""
    words, settings, usual = [method.name], asdict(method), method.defaults()
    if settings.get("architecture") != usual.get("architecture"):
        words.append(settings["architecture"])
    words += [
        word
        for word, (name, value) in _WORDS.items()
        if settings.get(name) == value != usual.get(name)
    ]
    words += [name for name, preset in method.presets.items() if preset.items() <= settings.items()]
    size = len(settings["features"]) if "features" in settings else settings.get("latent")
    return str(EncoderName("-".join(words), size))


def read_name(name: str) -> tuple[type[Method], dict[str, Any]]:
    """The method and settings that a name stands for: the inverse of `name_of`."""
    stem, latent, _ = EncoderName.parse(name)
    mistake = InputError(f"unknown representation {name!r}: {_EXAMPLES}")
    kinds = [kind for kind in METHODS if f"{stem}-".startswith(f"{kind}-")]
    if not kinds:
        raise mistake
    kind = max(kinds, key=len)
    method, given = METHODS[kind], dict[str, Any]({} if latent is None else {"latent": latent})
    for word in stem[len(kind) :].split("-")[1:]:
        setting, value = _WORDS.get(word, ("architecture", word))
        given |= method.presets.get(word, {setting: value})
    try:
        named = name_of(method.of(given))
    except InputError:
        raise mistake from None
    if named != name:
        raise mistake
    return method, given
