"""Every way of making an encoder, and how names say which."""

from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple, get_args

from msgspec.structs import asdict

from jbrep.coordinates import System
from jbrep.dataset.scaling import SCALINGS
from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError, choose
from jbrep.training.method import Method

_FILES = (  # of methods; each may have several
    "jbrep.methods.controls",
    "jbrep.methods.linear",
    "jbrep.dae.autoencoder",
    "jbrep.methods.ddae",
    "jbrep.methods.vae",
    "jbrep.methods.lld_vae",
    "jbrep.methods.lagged",
    "jbrep.methods.linear_forward",
    "jbrep.methods.forward",
    "jbrep.methods.self_prediction",
    "jbrep.methods.deepmdp",
    "jbrep.methods.ofe",
    "jbrep.methods.fourier",
)


def _methods(file: str) -> Iterator[type[Method]]:
    """The methods of a file, which are its classes with names of their own."""
    for each in vars(import_module(file)).values():
        if isinstance(each, type) and issubclass(each, Method) and "name" in vars(each):
            yield each


METHODS: dict[str, type[Method]] = {each.name: each for file in _FILES for each in _methods(file)}
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
