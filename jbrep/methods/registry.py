"""The methods that make encoders, and how names say which."""

from importlib import import_module
from typing import Any, NamedTuple, get_args

from msgspec.structs import asdict

from jbrep.coordinates import System
from jbrep.dataset.scaling import SCALINGS
from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError, choose
from jbrep.methods.kinds import KINDS
from jbrep.training.method import Method


def _method(kind: str, file: str) -> type[Method]:
    """The class of that name in a file."""
    classes = (each for each in vars(import_module(file)).values() if isinstance(each, type))
    return next(c for c in classes if issubclass(c, Method) and vars(c).get("name") == kind)


METHODS = {kind: _method(kind, file) for kind, file in KINDS.items()}
_WORDS: dict[str, tuple[str, Any]] = {  # in names, of settings that aren't the usual ones
    **{name: ("scaling", name) for name in SCALINGS},
    **{system: ("on", system) for system in get_args(System)},
    "raw": ("codes", "raw"),
    "unit": ("codes", "standard"),
    "white": ("codes", "white"),
}
_EXAMPLES = "it must be full, or a method and a latent size, such as dae-8, dae-deep-8 or slow-8"


def get_method(name: str) -> type[Method]:
    """The method of that name.

    Raises:
        InputError: the name is unknown; the message lists the methods.
    """
    return choose(name, METHODS, "kind")


class Recipe(NamedTuple):
    """A method with the settings that a name says."""

    method: type[Method]
    given: dict[str, Any]


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


def read_name(name: str) -> Recipe:
    """The method and settings that a name stands for: the inverse of `name_of`.

    Raises:
        InputError: it stands for none.
    """
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
    return Recipe(method, given)
