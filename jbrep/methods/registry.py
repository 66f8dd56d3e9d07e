"""Every way of making an encoder, and how names say which."""

from typing import Any, NamedTuple

from jbrep.dataset.scaling import EXTREMA, SCALINGS
from jbrep.encoders.encoder import FULL, IDENTITY
from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError, choose
from jbrep.methods import (
    autoencoder,
    ddae,
    deepmdp,
    forward,
    identity,
    linear_forward,
    lld_vae,
    noise,
    pca,
    random,
    self_prediction,
    slow,
    subset,
    untrained,
    vae,
    vamp,
)
from jbrep.methods.method import Method, Settings
from jbrep.methods.settings import STANDARD, WHITE

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        identity.METHOD,
        pca.METHOD,
        random.METHOD,
        subset.METHOD,
        noise.METHOD,
        untrained.METHOD,
        autoencoder.AE,
        autoencoder.DAE,
        ddae.METHOD,
        vae.METHOD,
        lld_vae.METHOD,
        slow.METHOD,
        vamp.METHOD,
        linear_forward.METHOD,
        forward.METHOD,
        self_prediction.METHOD,
        deepmdp.METHOD,
    )
}
_Meanings = dict[str, dict[str, Any]]
_UNUSUAL: _Meanings = {  # settings that a name says where they aren't the usual, by word
    "scaling": {name: name for name in SCALINGS if name != EXTREMA},
    "angles": {"angles": True},
    "codes": {"unit": STANDARD, "white": WHITE},
}


def get_method(name: str) -> Method:
    """The method of that name; `full` is another one for the identity.

    Raises:
        InputError: the name is unknown; the message lists the methods.
    """
    return choose(IDENTITY if name == FULL else name, METHODS, "kind")


class Recipe(NamedTuple):
    """A method with the settings that a name says."""

    method: Method
    given: dict[str, Any]


def name_of(method: Method, settings: Settings) -> str:
    """What an encoder is called: method, what is unusual about it, and latent size."""
    words = [method.name]
    if settings.get("architecture") != method.own.get("architecture"):
        words.append(str(settings["architecture"]))
    words += [
        word
        for name, meanings in _UNUSUAL.items()
        for word, value in meanings.items()
        if settings.get(name) == value
    ]
    for name, preset in method.presets.items():
        if all(settings[key] == value for key, value in preset.items()):
            words.append(name)
    if len(words) > 1 and method.name == IDENTITY:
        words[0] = FULL
    size = len(settings["features"]) if "features" in settings else settings.get("latent")
    return str(EncoderName("-".join(words), size))


def read_name(name: str) -> Recipe:
    """The method and settings that a name stands for: the inverse of `name_of`.

    Raises:
        InputError: it stands for none.
    """
    stem, latent, _ = EncoderName.parse(name)
    known = {FULL: METHODS[IDENTITY], **METHODS}
    starts = [each for each in known if f"{stem}-".startswith(f"{each}-")]
    if not starts:
        raise InputError(f"unknown representation {name!r}: {_EXAMPLES}")
    method = known[max(starts, key=len)]
    given: dict[str, Any] = {} if latent is None else {"latent": latent}
    rest = stem[len(max(starts, key=len)) + 1 :]
    for word in rest.split("-") if rest else ():
        given |= _meaning(word, method)
    try:
        named = name_of(method, method.settings(given))
    except InputError:
        named = ""
    if named not in (name, IDENTITY if name == FULL else name):
        raise InputError(f"unknown representation {name!r}: {_EXAMPLES}")
    return Recipe(method, given)


_EXAMPLES = "it must be full, or a method and a latent size, such as dae-8, dae-deep-8 or slow-8"


def _meaning(word: str, method: Method) -> dict[str, Any]:
    """The settings that a word in a name stands for."""
    for name, meanings in _UNUSUAL.items():
        if word in meanings:
            return {name: meanings[word]}
    if word in method.presets:
        return dict(method.presets[word])
    return {"architecture": word}
