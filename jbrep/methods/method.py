"""What a method of making encoders is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.settings import CODED, REQUIRED, SCALED, read_setting
from jbrep.training.objective import Layers, Objective

Settings = Mapping[str, Any]


class Made(NamedTuple):
    """What a method makes: layers between scaled rows and codes, and what it says of them."""

    encoder: Layers
    decoder: Layers | None = None  # None for the linear one of least squared error
    metrics: Settings = MappingProxyType({})  # plain JSON, for the file's header
    keep: tuple[str, ...] = ()  # features that pass around the layers, beside those it is told of


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way of making encoders from a data set.

    Attributes:
        name: what commands and files call it.
        words: what it makes, a line for help and tables.
        source: of its formula; empty if there is none.
        own: its own settings with their defaults, keys of SETTINGS.
        presets: named sets of settings.
        check: raises InputError if the data and settings can't be used, before anything is made.
        reduces: whether its code must be smaller than the observation.
    """

    name: str
    words: str
    source: str = ""
    own: Settings = field(default_factory=dict)
    presets: Mapping[str, Settings] = field(default_factory=dict)
    check: Callable[[ScaledDataset, Settings], None] = lambda data, settings: None
    reduces: bool = True

    @property
    def defaults(self) -> dict[str, Any]:
        """All settings that it takes, with their defaults."""
        return {**self.own, **SCALED, **(CODED if "latent" in self.own else {})}

    def settings(self, given: Settings) -> dict[str, Any]:
        """All its settings, with some given as text or as values; None is for the default.

        Raises:
            InputError: it doesn't take one, one can't have that value, or one is missing.
        """
        defaults = self.defaults
        if unknown := [name for name in given if name not in defaults]:
            raise InputError(f"{self.name} takes no {unknown[0]}: leave it out")
        read = {n: read_setting(n, value) for n, value in given.items() if value is not None}
        settings = {**self.fill(read), **read}
        if missing := [name for name, value in settings.items() if value is REQUIRED]:
            raise InputError(f"{self.name} needs {missing[0]}: there is no default")
        return settings

    def fill(self, given: Settings) -> dict[str, Any]:
        """The defaults of all settings, which may depend on those that are given."""
        return self.defaults

    def resolve(self, data: ScaledDataset, settings: Settings) -> dict[str, Any]:
        """The settings as the data need them, such as names of features in place of a pattern.

        Raises:
            InputError: they mean nothing there.
        """
        return dict(settings)


@dataclass(frozen=True, kw_only=True)
class ClosedForm(Method):
    """A method without training.

    Attributes:
        make: from scaled data and settings.
    """

    make: Callable[[ScaledDataset, Settings], Made]


@dataclass(frozen=True, kw_only=True)
class Learned(Method):
    """A method that trains a network by gradients.

    Attributes:
        objective: what it trains, from scaled data and settings.
    """

    objective: Callable[[ScaledDataset, Settings], Objective]
