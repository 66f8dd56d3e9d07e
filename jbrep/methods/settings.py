"""The settings that methods take, each said once: what it may be, and what it is for."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from jbrep.dae.network import get_architecture
from jbrep.dataset.scaling import EXTREMA, SCALINGS
from jbrep.encoders.layers import MAX_UNITS
from jbrep.errors import InputError

REQUIRED = object()  # stands for the default of a setting that has to be given
MAX_HORIZON = 1000  # steps ahead
_MAX_NUMBER = (1 << 63) - 1  # that torch accepts
_MAX_WEIGHT = 1e6
_MAX_LEARNING_RATE = 1  # beyond which Adam's steps are larger than any useful weight

RAW, STANDARD, WHITE = "raw", "standard", "white"  # codes


@dataclass(frozen=True)
class Setting:
    """A setting that some methods take.

    Attributes:
        words: what it is, a line for help.
        read: its value from text or from a value of its type. Raises ValueError, whose message
            says what it must be.
        is_flag: whether it is true or false, so that on a command line its name alone sets it.
    """

    words: str
    read: Callable[[Any], Any]
    is_flag: bool = False

    @property
    def is_list(self) -> bool:
        """Whether it takes several values: in a list, as text with commas, or one after another."""
        return self.read in (_steps, _words, _weights)


def _whole(least: int, most: int = _MAX_NUMBER) -> Callable[[Any], int]:
    """A whole number in a range, both ends included."""

    def read(value: Any) -> int:
        said = f"a whole number from {least} to {most}"
        if isinstance(value, bool) or not isinstance(value, (int, str)):
            raise ValueError(said)
        try:
            number = int(value)
        except ValueError:
            raise ValueError(said) from None
        if not least <= number <= most:
            raise ValueError(said)
        return number

    return read


def _number(least: float, most: float = math.inf, above: bool = False) -> Callable[[Any], float]:
    """A finite number in a range; above its lower end if so told."""

    def read(value: Any) -> float:
        said = f"a number {'above' if above else 'from'} {least:g}"
        said += "" if most == math.inf else f"{' and at most' if above else ' to'} {most:g}"
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise ValueError(said)
        try:
            number = float(value)
        except ValueError:
            raise ValueError(said) from None
        if not (least < number if above else least <= number) or not number <= most:
            raise ValueError(said)
        if not math.isfinite(number):
            raise ValueError(said)
        return number

    return read


def _choice(choices: Iterable[str]) -> Callable[[Any], str]:
    known = tuple(choices)

    def read(value: Any) -> str:
        if value not in known:
            raise ValueError(f"one of {', '.join(known)}")
        return str(value)

    return read


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def _list(value: Any) -> list[Any]:
    """What is given as a list, or as text with commas, or as one value."""
    if isinstance(value, str):
        return [part.strip() for part in value.split(",")]
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _steps(value: Any) -> tuple[int, ...]:
    """Different numbers of steps ahead, in order."""
    read = _whole(1, MAX_HORIZON)
    try:
        return tuple(sorted({read(each) for each in _list(value)}))
    except ValueError:
        raise ValueError(f"steps from 1 to {MAX_HORIZON}, such as 10 or 1,5,10") from None


def _words(value: Any) -> tuple[str, ...]:
    """Different words, in order."""
    words = _list(value)
    if not all(isinstance(word, str) and word for word in words):
        raise ValueError("names, such as angle_to_target,velocity_x")
    return tuple(dict.fromkeys(words))


def _weights(value: Any) -> dict[str, float]:
    """A weight by name: {"name": weight}, or text such as angle_to_target=4,velocity_x=0.5."""
    weight = _number(0, _MAX_WEIGHT)
    try:
        pairs = (
            value.items()
            if isinstance(value, Mapping)
            else [each.split("=") for each in _list(value)]
        )
        return {str(name): weight(number) for name, number in pairs}
    except (ValueError, AttributeError):
        raise ValueError("weights of features, such as angle_to_target=4,velocity_x=0.5") from None


def _architecture(value: Any) -> str:
    return get_architecture(str(value)).name


SETTINGS = {
    "latent": Setting("Latent units l.", _whole(1, MAX_UNITS)),
    "architecture": Setting(
        "Layers of the network: paper, deep, linear, or sizes of your own, such as 64,64.",
        _architecture,
    ),
    "epochs": Setting("Passes over the data.", _whole(1)),
    "batch_size": Setting(
        "Rows in a batch; by default 128 to 8192, from the rows, unless the method has its own.",
        _whole(1),
    ),
    "learning_rate": Setting("Of Adam.", _number(0, _MAX_LEARNING_RATE, above=True)),
    "seed": Setting("Of everything random.", _whole(0)),
    "noise": Setting("Standard deviation of the corruption.", _number(0)),
    "shared_noise": Setting("Corrupt all rows of a batch alike.", _flag, is_flag=True),
    "initial": Setting(
        "Weights to begin with: torch, its own; or normal, N(0, 1) with biases of 0.",
        _choice(("torch", "normal")),
    ),
    "weights": Setting("Weights of features in the error; 1 otherwise.", _weights),
    "lags": Setting("Steps from now to later, one or several.", _steps),
    "horizons": Setting("Steps ahead that are predicted, one or several.", _steps),
    "changes": Setting("Weight of all changes of features.", _number(0, _MAX_WEIGHT)),
    "values": Setting("Weight of all future values of features.", _number(0, _MAX_WEIGHT)),
    "reward": Setting("Weight of the reward.", _number(0, _MAX_WEIGHT)),
    "inverse": Setting("Weight of the action, from now and later.", _number(0, _MAX_WEIGHT)),
    "lipschitz": Setting("Weight of the Lipschitz penalty.", _number(0, _MAX_WEIGHT)),
    "ahead": Setting("Steps ahead of the row that is reconstructed.", _whole(0, MAX_HORIZON)),
    "beta": Setting("Weight of the divergence from the prior.", _number(0, _MAX_WEIGHT)),
    "transition": Setting("Weight of the error of the next code.", _number(0, _MAX_WEIGHT)),
    "weight_decay": Setting("Weight of half the squared weights.", _number(0, _MAX_WEIGHT)),
    "features": Setting("Names of features, or patterns such as velocity_*.", _words),
    "scaling": Setting(f"What becomes -1 and 1: {', '.join(SCALINGS)}.", _choice(SCALINGS)),
    "angles": Setting("Take angles as sine and cosine.", _flag, is_flag=True),
    "clip": Setting("Limit of scaled values, at least 1; none by default.", _number(1, 1e6)),
    "keep": Setting("Features that pass around the encoder.", _words),
    "codes": Setting(
        "Scale of the code: raw, as the method gives it; standard, mean 0 and standard deviation "
        "1/3 of each unit; or white, uncorrelated as well.",
        _choice((RAW, STANDARD, WHITE)),
    ),
}
SCALED = {"scaling": EXTREMA, "angles": False, "clip": None}  # settings of every method
CODED = {"keep": (), "codes": RAW}  # and of those with a code


def read_setting(name: str, value: Any) -> Any:
    """The value of a setting, from text or from a value of its type.

    Raises:
        InputError: it can't have that value.
    """
    try:
        return SETTINGS[name].read(value)
    except InputError:
        raise
    except ValueError as error:
        said = name.replace("_", " ")
        raise InputError(f"{said} is {value}: it must be {error}") from None
