"""What names stand for: tasks in Gymnasium's registry, modules, code, a robot's own files."""

import difflib
import hashlib
import json
import os
import re
import shlex
import sys
import sysconfig
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache, reduce
from importlib import import_module, metadata
from itertools import count
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium
from gymnasium.envs.registration import EnvSpec

from jbrep.envs.task import SHORT_NAMES, Task
from jbrep.errors import InputError, kind_and_line, refusing
from jbrep.records.storage import read_file

_CODE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", re.ASCII)
_RANDOM_ID = re.compile(rb"[0-9a-f]{32}")  # that cloudpickle gives a class of a script
_INSTALLED = (  # packages, whose versions stand for their code
    *(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib")),
    Path(__file__).resolve().parents[1],
)
INSTANCE = "instance/"  # begins the ids of users' instances, of which there is one each
_imported: list[str] = []


def find_spec(name: str) -> EnvSpec:
    """What is registered under a short name or an id.

    ModuleNotFoundError says that the package that registers the id isn't installed.
    """
    if ":" in name:
        raise InputError(
            f"the task {name!r} names a module: importing it runs its code, so this is possible on "
            "a command line only; elsewhere `import` the module, and give the id alone"
        )
    if name.startswith("dm_control/"):
        _import_shimmy()
    _register_class_of(name)
    try:
        return gymnasium.spec(SHORT_NAMES.get(name, name))
    except gymnasium.error.Error:
        near = difflib.get_close_matches(name, [*SHORT_NAMES, *gymnasium.registry], n=3)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise InputError(
            f"unknown task {name!r}: {hint}choose one of {', '.join(SHORT_NAMES)}, or an id that "
            "Gymnasium knows; for one of another package, `import` it first"
        ) from None


def spec_of(task: Task) -> EnvSpec:
    """What is registered under a task's id."""
    try:
        return find_spec(task.id)
    except InputError as error:
        if modules := modules_of(task):
            raise InputError(
                f"unknown task {task.id!r}: {modules[0]} defines it; `import` "
                f"{shlex.quote(modules[0])}, or the module that registers it: this runs its code"
            ) from None
        raise InputError(f"{error}. What comes of a log alone has no environment") from None


def modules_of(task: Task) -> list[str]:
    """The user's module that defines a task's environment, in a list; empty if a package does."""
    parts = [part.partition(" ") for part in task.files or ()]
    return [name for kind, _, name in parts if kind == "module"]


def import_modules(modules: Iterable[str]) -> None:
    """Import modules that a user names, also from the working directory; this runs their code."""
    for module in modules:
        if module.endswith(".py") or "/" in module:
            name = module.rpartition("/")[2].removesuffix(".py")
            raise InputError(
                f"{module} is a file: name its module, {name}, from the folder that it is in"
            )
        try:
            if "" not in sys.path:
                sys.path.append("")  # after all that is installed
            with warnings.catch_warnings():  # dm_control opens OpenGL
                warnings.filterwarnings("ignore", ".*DISPLAY environment variable is missing")
                import_module(module)
        except Exception as error:
            raise InputError(f"can't import {module}: {kind_and_line(error)}") from None
        if module not in _imported:
            _imported.append(module)


class Known(NamedTuple):
    """What another process imports and registers, to make the same environments."""

    modules: tuple[str, ...]
    specs: tuple[EnvSpec, ...]  # which also what isn't imported by `import_modules` registered

    @classmethod
    def of(cls, tasks: Iterable[Task]) -> "Known":
        """What this process knows of tasks."""
        # those of dm_control can't be sent, and are registered wherever they are asked for
        own = [task for task in tasks if not task.id.startswith("dm_control/")]
        return cls(tuple(_imported), tuple(map(spec_of, own)))

    def take(self) -> None:
        """Import and register it in this process."""
        import_modules(self.modules)
        for spec in self.specs:
            gymnasium.registry.setdefault(spec.id, spec)


def imported(module: str) -> ModuleType | None:
    """A module, if `import_modules` was asked for it."""
    return sys.modules.get(module) if module in _imported else None


def is_code(name: object) -> bool:
    """Whether a text names code, as in mymodule:MyEncoder, rather than a file."""
    return isinstance(name, (str, Path)) and _CODE.fullmatch(str(name)) is not None


def import_code(name: object) -> None:
    """Import the module of code that a command line names; nothing for another text."""
    if is_code(name):
        import_modules([str(name).partition(":")[0]])


def code_named(name: str, what: str) -> Any:
    """What a name of code stands for, as in mymodule:MyEncoder; messages call it `what`."""
    module, _, path = name.partition(":")
    thing = imported(module)
    if thing is None:
        raise InputError(
            f"the {what} {name} is code: importing {module} runs it; if you trust it, `import` "
            f"{module}"
        )
    with refusing(f"can't make the {what} {name}", (AttributeError,)):
        return attrgetter(path)(thing)


def name_given(text: str) -> str:
    """The task that a command line names, once the module before its colon has been imported."""
    module, colon, name = text.rpartition(":")
    if colon:
        import_modules([module])
        known = _found(sys.modules[module], name)
        if name not in gymnasium.registry and isinstance(known, type):
            return taken_for(known)[0]
    return name


def _found(module: Any, path: str) -> Any:
    """What a module has at a path such as Outer.Env; None if there is nothing."""
    return reduce(lambda part, name: getattr(part, name, None), path.split("."), module)


# environments that no id is registered for


def taken_for(given: Any) -> tuple[str, dict[str, Any], int | None]:
    """The id of what is given for a task, the arguments and the time limit that it was made with.

    A class is registered as MODULE/CLASS; an instance that `gymnasium.make` didn't make, or that
    has more wrappers, is this process's alone.
    """
    if isinstance(given, str):
        return given, {}, None
    if isinstance(given, type) and issubclass(given, gymnasium.Env):
        module, path = given.__module__, given.__qualname__
        name = f"{module.replace('.', '-')}/{path.rpartition('<locals>.')[2]}"
        if module not in (*_imported, "__main__"):  # other processes import it, too
            _imported.append(module)
        if "<locals>" in path:  # a function may make several of that name
            name = _numbered(name, given)
        return _registered(name, given), {}, None
    if not isinstance(given, gymnasium.Env):
        raise InputError(f"the task is {given!r}: it must be a name, a Task or an environment")
    made = given.spec
    if made and made.id in gymnasium.registry and not made.additional_wrappers:
        usual = {**gymnasium.spec(made.id).kwargs, "render_mode": made.kwargs.get("render_mode")}
        differing = {n: v for n, v in made.kwargs.items() if repr(usual.get(n)) != repr(v)}
        return made.id, differing, made.max_episode_steps
    name = _numbered(f"{INSTANCE}{type(given.unwrapped).__name__}", given)
    lent = _Lent(given)
    limit = made.max_episode_steps if made else None
    return _registered(name, lambda: lent, limit), {}, None


_locals: dict[str, Any] = {}  # users' instances and classes that no module names, by their ids


def _numbered(name: str, given: Any) -> str:
    """A name that is that thing's alone, with a number if another has it."""
    names = (f"{name}-{number}" if number else name for number in count())
    return next(each for each in names if _locals.setdefault(each, given) is given)


def _registered(name: str, maker: Any, limit: int | None = None) -> str:
    gymnasium.registry[name] = EnvSpec(name, maker, max_episode_steps=limit)
    return name


class _Lent(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A user's instance, which stays open: it is theirs to close."""

    def close(self) -> None:
        pass


def _register_class_of(name: str) -> None:
    """Register the class that an id names as MODULE/CLASS, if a user had that module imported."""
    module, _, kind = name.partition("/")
    known = _found(imported(module.replace("-", ".")), kind)
    if name not in gymnasium.registry and isinstance(known, type):
        taken_for(known)


def environment_versions(task: Task) -> dict[str, str]:
    """Versions of the packages that a task's environment comes from, but jbrep's own."""
    entry_point: Any = spec_of(task).entry_point
    maker = getattr(entry_point, "func", entry_point)  # shimmy's are partial functions
    module = maker if isinstance(maker, str) else getattr(maker, "__module__", "")
    package = module.partition(":")[0].partition(".")[0]
    if package == "jbrep":
        return {}
    behind = ["dm-control"] if package == "shimmy" else []
    names = {"gymnasium", *_distributions().get(package, []), *behind}
    return {name: metadata.version(name) for name in sorted(names)}


@cache
def _distributions() -> Mapping[str, list[str]]:
    """What every package that is installed belongs to: each has a list of its files to be read."""
    return metadata.packages_distributions()


def _import_shimmy() -> None:
    """Register dm_control's tasks; it opens OpenGL, and complains of a missing display."""
    from jbrep.opengl import prepare_opengl

    prepare_opengl()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import_module("shimmy")


# a robot's own files


def absolute(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments in which the files and folders that they name are absolute paths."""
    return {name: str(_path(value) or "") or value for name, value in arguments.items()}


def files_of(arguments: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the files that arguments name, such as a model, by the arguments' names."""
    paths = {name: _path(value) for name, value in arguments.items()}
    return {name: file_digest(path) for name, path in paths.items() if path and path.is_file()}


def code_of(maker: Any) -> dict[str, str]:
    """SHA-256 of the user's file that defines a class or function, by the name of its module."""
    name = getattr(getattr(maker, "func", maker), "__module__", "")  # of a partial function, too
    return _module_code(name)


def with_digest(code: str, what: str) -> str:
    """A name of code, as in mymodule:act, with a digest of the user's files that define it."""
    files = _module_code(code.partition(":")[0]) | code_of(code_named(code, what))
    return f"{code} {_short(json.dumps(sorted(files.items())).encode())}"


def digest_of(thing: Any) -> str:
    """The same digest of a Python object: of its code, what it holds, or its weights."""
    import cloudpickle

    if hasattr(thing, "state_dict"):  # torch pickles addresses, too
        content = b"".join(each.numpy(force=True).tobytes() for each in thing.state_dict().values())
    else:
        with refusing("the policy can't be told from others: give it as module:function"):
            content = _RANDOM_ID.sub(b"", cloudpickle.dumps(thing))
    return _short(content + json.dumps(sorted(code_of(thing).items())).encode())


def _short(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def _module_code(name: str) -> dict[str, str]:
    file = getattr(sys.modules.get(name), "__file__", None)
    path = Path(file).resolve() if file and name != "__main__" else None
    if path is None or not path.is_file() or any(each in path.parents for each in _INSTALLED):
        return {}
    return {f"module {name}": file_digest(path)}


def _path(value: Any) -> Path | None:
    """The file that text names, by a separator or a suffix, or the folder, by a separator."""
    if not isinstance(value, str):
        return None
    has_separator = "/" in value or os.sep in value
    with suppress(OSError, ValueError, RuntimeError):
        path = Path(os.path.abspath(Path(value).expanduser()))  # noqa: PTH100 - without ".."
        if (path.is_file() and (has_separator or path.suffix)) or (has_separator and path.is_dir()):
            return path
    return None


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(read_file(path)).hexdigest()
