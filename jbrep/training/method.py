"""What a method of making encoders is: a record of its settings, which makes an encoder of data."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

from msgspec import NODEFAULT, field, inspect
from msgspec.structs import asdict, fields, force_setattr

from jbrep.dataset import ScaledDataset
from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.records.record import Record, bare, default_of, from_text, to_plain, type_of
from jbrep.training import settings
from jbrep.training.network import get_architecture
from jbrep.training.objective import Layers, Objective


class Made(NamedTuple):
    """What a method makes: layers between scaled rows and codes, and what it says of them."""

    encoder: Layers
    decoder: Layers | None = None  # None for the linear one of least squared error
    metrics: Mapping[str, Any] = MappingProxyType({})  # plain JSON, for the file's header
    keep: tuple[str, ...] = ()  # features that pass around the layers, beside those it is told of


class Method(Record, frozen=True, kw_only=True):
    """A way of making encoders from a data set; its fields are its settings.

    A class says its `name`, which commands and files use, and in the first line of its docstring
    what it makes. From its fields follow the options of the command line, their help, and the
    encoder's header.
    """

    name: ClassVar[str]
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}  # named sets of settings
    min_reduction: ClassVar[int | None] = None  # of features to numbers; None: any size will do

    scaling: settings.Scaling = "extrema"
    on: settings.On = "observation"
    leave_out: settings.LeaveOut = ()
    clip: settings.Clip = None

    @property
    def keep(self) -> tuple[str, ...]:
        """Features that pass around the layers; of those with a code, a setting."""
        return ()

    @property
    def codes(self) -> str:
        """The scale of the code; of those with a code, a setting."""
        return "raw"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in asdict(self).items():
            if isinstance(value, tuple):  # different ones, numbers in order
                once = dict.fromkeys(value)
                ordered = sorted(once) if all(isinstance(v, int) for v in once) else once
                force_setattr(self, name, tuple(ordered))

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """The method with settings as text, such as 1,5,10, or as values; None for the default."""
        kinds = {field.name: field.type for field in fields(cls)}
        if unknown := [name for name in given if name not in kinds]:
            raise InputError(f"{cls.name} takes no {unknown[0]}: leave it out")
        read = {n: _read(v, kinds[n], n) for n, v in given.items() if v is not None}
        values = {**cls.defaults(read), **read}
        if missing := [name for name in kinds if name not in values]:
            raise InputError(f"{cls.name} needs {missing[0]}: there is no default")
        return cls(**values)

    @classmethod
    def words(cls) -> str:
        """What it makes, in a line."""
        return (cls.__doc__ or "").partition("\n")[0].removesuffix(".")

    @classmethod
    def takes(cls, setting: str) -> bool:
        """Whether it has that setting."""
        return setting in cls.__struct_fields__

    @classmethod
    def defaults(cls, given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
        """The defaults of all settings that have one; they may depend on what is given."""
        each = {field.name: default_of(field) for field in fields(cls)}
        return {name: default for name, default in each.items() if default is not NODEFAULT}

    @classmethod
    def largest(cls, size: int) -> int | None:
        """The largest latent size for an observation of `size` features; None if any will do."""
        return None if cls.min_reduction is None else size - cls.min_reduction

    @property
    def training(self) -> dict[str, Any]:
        """Its settings as plain JSON; of those that every method has, only what is unusual."""
        plain = to_plain(self)
        unusual = {n: plain[n] for n in USUAL if n in plain and plain[n] != USUAL[n]}
        return {name: value for name, value in plain.items() if name not in USUAL} | unusual

    def resolved(self, data: ScaledDataset) -> Self:
        """The method as the data need it, such as with names of features in place of a pattern."""
        return self

    def check_data(self, data: ScaledDataset) -> None:
        """Check, before anything is made, that an encoder can be made from the data."""


class Coded(Method, frozen=True, kw_only=True):
    """A method with a code of its own size."""

    min_reduction: ClassVar[int | None] = 1

    latent: settings.Latent
    keep: settings.Keep = ()
    codes: settings.Codes = "raw"

    def check_data(self, data: ScaledDataset) -> None:
        largest = self.largest(data.size)
        if not data.size or (largest is not None and largest < 1):
            beside = " beside what is kept" if self.keep else ""
            raise InputError(
                f"{data.task.name} has {data.size or 'no'} feature to encode{beside}, too few: use "
                f"{FULL}"
            )
        if largest is not None and self.latent > largest:
            raise InputError(
                f"latent size is {self.latent}: with {data.size} features it must be from 1 to "
                f"{largest}"
            )


USUAL: dict[str, Any] = to_plain(Coded.defaults())  # settings of all methods with a code


class Network(Coded, frozen=True, kw_only=True):
    """A method with a network of chosen layers."""

    if TYPE_CHECKING:  # a field of each class: only one of several bases can have more
        architecture: str

    def __post_init__(self) -> None:
        super().__post_init__()
        force_setattr(self, "architecture", get_architecture(self.architecture).name)


class ClosedForm(Method, frozen=True, kw_only=True):
    """A method without training."""

    def make(self, data: ScaledDataset) -> Made:
        """What it makes of scaled data."""
        raise NotImplementedError


class Learned(Coded, frozen=True, kw_only=True):
    """A method that trains a network by gradients."""

    epochs: settings.Epochs = 12
    batch_size: settings.BatchSize = None
    learning_rate: settings.LearningRate = 2e-3
    seed: settings.Seed = 0

    def objective(self, data: ScaledDataset) -> Objective:
        """What it trains, on scaled data."""
        raise NotImplementedError


class Reconstructing(Learned, frozen=True, kw_only=True):
    """A method that learns to reconstruct rows, with weights of their features."""

    weights: settings.FeatureWeights = field(default_factory=dict)


def _read(value: Any, kind: Any, name: str) -> Any:
    if isinstance(value, str):
        return from_text(value, kind, name)
    is_list = isinstance(bare(type_of(kind)), inspect.CollectionType)
    return [value] if is_list and not isinstance(value, list | tuple) else value
