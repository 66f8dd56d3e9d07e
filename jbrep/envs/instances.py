"""The environments that this process has open.

A robot may exist once: one environment that nobody uses is kept for the next who asks for it, so
that describing, collecting and evaluating in turn have the same instance. All are closed at the
end, whatever happens.
"""

import atexit
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
from gymnasium.wrappers import TimeLimit

from jbrep.envs.disturbed import Varied
from jbrep.envs.domain import Domain
from jbrep.envs.make import aside, make_env
from jbrep.envs.names import files_of, find_spec
from jbrep.errors import Notice, kind_and_line

Env = gymnasium.Env[Any, Any]
_Key = tuple[Any, ...]
_NO_LIMIT = -1  # as gymnasium.make takes it


class _Instance(NamedTuple):
    key: _Key  # what it is
    env: Env
    given: Mapping[str, Any]  # its arguments
    files: Mapping[str, str] = {}  # hashes of those that they name, when it was last used


_used: dict[int, _Instance] = {}  # by the identity of what was lent
_kept: list[_Instance] = []  # one at most


def take(
    env_id: str,
    arguments: Mapping[str, Any],
    max_episode_steps: int | None = None,
    domain: Domain | None = None,
) -> Env:
    """An environment to use: the one that is kept, if it is the same, or else a new one.

    Args:
        env_id: in the registry, or a short name.
        arguments: of the environment.
        max_episode_steps: the time limit; None takes the registered one.
        domain: from which each episode draws its physics, if it does.
    """
    spec = find_spec(env_id)
    given = {**spec.kwargs, **arguments}
    key = spec.id, spec.entry_point, repr(given), domain
    limit = max_episode_steps or spec.max_episode_steps
    bare = _take_kept(key, given) or _make(env_id, arguments, domain)
    env = TimeLimit(bare, limit) if limit else bare
    _used[id(env)] = _Instance(key, bare, given)
    return env


def _make(env_id: str, arguments: Mapping[str, Any], domain: Domain | None) -> Env:
    env = make_env(env_id, arguments, _NO_LIMIT)
    return Varied(env, domain) if domain else env


def _take_kept(key: _Key, given: Mapping[str, Any]) -> Env | None:
    """The kept one if it is that; another is closed, since it may have what a new one needs."""
    if not _kept:
        return None
    kept = _kept.pop()
    if kept.key == key and kept.files == files_of(given):
        return kept.env
    _close(kept.env)
    return None


def give_back(env: Env) -> None:
    """Keep an environment that is no longer used, in place of the one before."""
    if used := _used.pop(id(env), None):
        close_kept()
        _kept.append(used._replace(files=files_of(used.given)))  # which it may have written


def discard(env: Env) -> None:
    """Close an environment that failed."""
    if used := _used.pop(id(env), None):
        _close(used.env)


def close_kept() -> None:
    """Close what nobody uses, so that another process can have it."""
    while _kept:
        _close(_kept.pop().env)


@atexit.register
def close_all() -> None:
    """Close every environment, used or not."""
    close_kept()
    while _used:
        _close(_used.popitem()[1].env)


def _close(env: Env) -> None:
    try:
        with aside():
            env.close()
    except Exception as error:
        warnings.warn(f"an environment can't be closed: {kind_and_line(error)}", Notice, 2)
