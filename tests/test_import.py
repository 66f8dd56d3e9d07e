"""Data that were made elsewhere become data sets like any other, or are refused in a line."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import h5py
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces
from small import flip_bit, settings

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.collecting.replay import replay_problems
from jbrep.dataset import Dataset, from_arrays
from jbrep.dataset.formats import FORMATS, export, open_sources
from jbrep.dataset.formats.writer import write
from jbrep.dataset.manifest import find_problems, shard_path
from jbrep.envs import describe
from jbrep.envs.names import import_modules
from jbrep.envs.task import check_same
from jbrep.errors import InputError, Notice

import_modules(["environments"])


def import_data(given, folder, task=None):
    """What `jbrep data import` does; why the task is made from the data alone, if it is."""
    source = open_sources([given])
    write(source, folder, task)
    return source.why_no_task


PENDULUM = "Pendulum-v1"
LENGTHS = (7, 1, 12)  # the middle one is terminated, the last one still going on
EPISODE = np.repeat([4, 2, 9], LENGTHS)
STEP = np.concatenate([np.arange(length) for length in LENGTHS])


def arrays(sizes=(3, 1), lengths=LENGTHS):
    """Steps of episodes one after the other, and what follows each."""
    random, rows = np.random.default_rng(0), sum(lengths)
    ends = np.cumsum(lengths) - 1
    observation = random.normal(size=(rows + len(lengths), sizes[0])).astype(np.float32)
    finals = ends + 1 + np.arange(len(lengths))
    return {
        "observations": np.delete(observation, finals, axis=0),
        "actions": random.uniform(-2, 2, (rows, sizes[1])).astype(np.float32),
        "rewards": random.normal(size=rows).astype(np.float32),
        "terminations": np.arange(rows) == ends[1],
        "truncations": np.arange(rows) == ends[0],
        "final_observations": observation[finals],
    }


def same(dataset, given, lengths=LENGTHS):
    """Check that a data set holds the arrays, and verifies."""
    for column, name in (("observation", "observations"), ("action", "actions")):
        np.testing.assert_array_equal(dataset[column], given[name])
    np.testing.assert_array_equal(dataset["reward"], given["rewards"])
    np.testing.assert_array_equal(dataset["episode"], np.repeat(range(len(lengths)), lengths))
    assert dataset.episodes["length"].tolist() == list(lengths)
    np.testing.assert_array_equal(
        dataset.episodes["final_observation"], given["final_observations"]
    )
    assert not list(find_problems(dataset.folder))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("import") / "written"
    return from_arrays(folder, **arrays(), seeds=[5, -1, 2**62], source="pushes of a pole, 2019")


def test_arrays_become_a_data_set(written):
    same(written, arrays())
    assert written.episodes["terminated"].tolist() == [0, 1, 0]
    assert written.episodes["truncated"].tolist() == [1, 0, 1]
    assert written.episodes["seed"].tolist() == [5, -1, 2**62]
    task, settings = written.task, written.manifest.settings
    assert task.id == task.name == "pushes-of-a-pole--2019"
    assert task.feature_names == ("obs_0", "obs_1", "obs_2")
    assert (task.action_low[0], task.action_high[0]) == (
        arrays()["actions"].min(),
        arrays()["actions"].max(),
    )
    assert (task.max_episode_steps, task.reproducible) == (12, False)
    assert settings.policy == {"kind": "imported", "source": "pushes of a pole, 2019"}


def test_a_list_of_episodes_gives_the_same(written, tmp_path):
    given, ends = arrays(), np.cumsum(LENGTHS)[:-1]
    finals = given.pop("final_observations")
    listed = {name: np.split(values, ends) for name, values in given.items()}
    listed["observations"] = [
        np.append(rows, final[None], axis=0)
        for rows, final in zip(listed["observations"], finals, strict=True)
    ]
    again = from_arrays(tmp_path / "listed", **listed)
    names = [name for name in again.columns if name != "seed"]
    for name in names:
        np.testing.assert_array_equal(again[name], written[name])
    np.testing.assert_array_equal(again.episodes["terminated"], written.episodes["terminated"])


def test_without_the_final_observation_the_last_step_is_left_out(tmp_path):
    given = arrays()
    del given["final_observations"]
    with pytest.warns(Notice, match="3 rows at the end of an episode"):
        dataset = from_arrays(tmp_path / "data", **given)
    assert dataset.episodes["length"].tolist() == [6, 11]  # nothing is left of the one of a step
    np.testing.assert_array_equal(
        dataset.episodes["final_observation"], given["observations"][[6, 19]]
    )
    assert dataset.episodes["terminated"].tolist() == [0, 0]
    assert not list(find_problems(dataset.folder))


def test_a_described_task_brings_its_names_and_bounds(tmp_path):
    dataset = from_arrays(tmp_path / "data", **arrays(), task=PENDULUM)
    assert dataset.task == describe(PENDULUM)
    alone = from_arrays(tmp_path / "alone", **arrays(), source=PENDULUM)
    check_same(describe(PENDULUM), alone.task, "an encoder")  # so it works there


def test_a_data_frame_names_the_features(tmp_path):
    given = arrays()
    names = [f"joint_{i}" for i in range(given["observations"].shape[1])]
    given["observations"] = pandas.DataFrame(given["observations"], columns=names)
    given["rewards"] = pandas.Series(given["rewards"])
    dataset = from_arrays(tmp_path / "data", **given)
    assert dataset.task.feature_names == tuple(names)
    np.testing.assert_array_equal(dataset["joint_1"][0], given["observations"]["joint_1"][0])


def test_shards_are_of_the_usual_size_and_hold_many_chunks(tmp_path):
    lengths = (999, 500, 1500) * 20
    given = arrays(lengths=lengths)
    ends = np.cumsum(lengths) - 1
    given["truncations"] = np.isin(np.arange(sum(lengths)), ends)
    given["terminations"] = np.zeros(sum(lengths), bool)
    dataset = from_arrays(tmp_path / "data", **given)
    same(dataset, given, lengths)
    assert [entry.episodes for entry in dataset.manifest.shards] == [20, 20, 20]


def table(dataset):
    """Columns, and what is known once for each episode, that an export keeps."""
    once = ("length", "seed", "return", "terminated", "truncated", "final_observation")
    columns = {n: np.asarray(dataset[n]) for n in ("observation", "action", "reward", "step")}
    return columns | {name: dataset.episodes[name] for name in once}


@pytest.fixture(scope="module", params=["face_direction", "Sledges/Nested-v0"])
def any_data(request, collected, tmp_path_factory):
    """Data sets of one action and of several, also with observations of several parts."""
    if request.param == "face_direction":
        return Dataset(collected)
    folder = tmp_path_factory.mktemp("sledges") / "data"
    some = settings(request.param, steps=60, shard_episodes=5, store_state=False)
    collect(some, folder, num_threads=1)
    return Dataset(folder)


@pytest.mark.parametrize("to", [to for to in FORMATS if to != "lerobot"])
def test_what_is_exported_comes_back(to, any_data, tmp_path):
    dataset, out = any_data, tmp_path / (f"data.{to}" if to != "minari" else "minari")
    export(dataset, to, out)
    given = next(out.glob("**/uniform-v0")) if to == "minari" else out
    names_task = to == "parquet" or (to == "minari" and dataset.task.name == "face_direction")
    import_data(str(given), tmp_path / "back", None if names_task else dataset.task)
    back = Dataset(tmp_path / "back")
    for name, values in table(dataset).items():
        np.testing.assert_array_equal(table(back)[name], values, err_msg=name)
    assert back.task == dataset.task.replace(state={}, constants={})
    assert not list(find_problems(back.folder))


@pytest.mark.parametrize("to", ["npz", "minari"])
def test_an_episode_may_have_ended_in_both_ways(to, tmp_path):
    rows, last = np.arange(12.0)[:, None], np.arange(12) % 4 == 3
    ends = {"terminations": last & (rows[:, 0] > 4), "truncations": last & (rows[:, 0] < 8)}
    final = {"final_observations": np.zeros((3, 1))}
    dataset = from_arrays(tmp_path / "both", rows, rows, rows[:, 0], **ends, **final)
    out = tmp_path / (f"data.{to}" if to != "minari" else "minari")
    export(dataset, to, out)
    given = next(out.glob("**/imported-v0")) if to == "minari" else out
    import_data(str(given), tmp_path / "back", dataset.task if to == "npz" else None)
    for each in (dataset, Dataset(tmp_path / "back")):
        assert each.episodes["terminated"].tolist() == [0, 1, 1]
        assert each.episodes["truncated"].tolist() == [1, 1, 0]


def test_what_is_hidden_goes_to_minari(collected, tmp_path):
    """Beside the whole; without the environment, which shows more."""
    derive(collected, tmp_path / "seen", ["*velocity*"])
    seen = Dataset(tmp_path / "seen")
    export(Dataset(collected), "minari", tmp_path / "out")
    export(seen, "minari", tmp_path / "out")
    (hidden,) = (tmp_path / "out").glob("jitterbug/*without*/uniform-v0")
    assert "env_spec" not in json.loads((hidden / "data/metadata.json").read_text())
    assert import_data(str(hidden), tmp_path / "back") == "it names no environment"
    np.testing.assert_array_equal(Dataset(tmp_path / "back")["observation"], seen["observation"])


def d4rl(path, **changes):
    given = arrays()
    following = np.append(given["observations"][1:], given["observations"][:1], axis=0)
    following[np.cumsum(LENGTHS) - 1] = given.pop("final_observations")
    names = {"terminations": "terminals", "truncations": "timeouts"}
    given = {names.get(name, name): values for name, values in given.items()}
    given |= {"next_observations": following, "infos/qpos": np.zeros((20, 4))}
    given["observations"] = np.asfortranarray(given["observations"])
    np.savez_compressed(path, **{**given, **changes})


def plain_table(path, **changes):
    given = arrays()
    columns = {f"joint {i}": given["observations"][:, i] for i in range(3)}
    columns |= {"action_0": given["actions"][:, 0], "reward": given["rewards"].astype(float)}
    columns |= {"episode": EPISODE, "step": STEP}
    pq.write_table(pa.table({**columns, **changes}), path)


def test_a_table_with_columns_of_features(tmp_path):
    plain_table(tmp_path / "a.parquet")
    import_data(str(tmp_path / "a.parquet"), tmp_path / "data")
    dataset = Dataset(tmp_path / "data")
    assert dataset.task.feature_names == ("joint_0", "joint_1", "joint_2")
    np.testing.assert_array_equal(dataset["joint_1"][:6], arrays()["observations"][:6, 1])
    assert dataset.episodes["length"].tolist() == [6, 11]


@pytest.fixture(scope="module")
def minari_folder(tmp_path_factory):
    """Two data sets in Minari's folder: one of an environment that is here, one of another."""
    import minari
    from minari.data_collector import EpisodeBuffer

    root = tmp_path_factory.mktemp("minari")
    given = arrays()
    rows = np.append(given["observations"], given["final_observations"][-1:], axis=0)
    position, rest = rows[:, :1], rows[:, 1:]
    buffers = [
        EpisodeBuffer(
            observations={"position": position[8:], "rest": rest[8:]},
            actions=given["actions"][8:],
            rewards=list(given["rewards"][8:]),
            terminations=[False] * 12,
            truncations=[False] * 11 + [True],
            infos={},
        )
    ]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on the missing author and address
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        minari.create_dataset_from_buffers(
            "cart/push-v0",
            buffers,
            observation_space=spaces.Dict(
                {
                    "position": spaces.Box(-np.inf, np.inf, (1,)),
                    "rest": spaces.Box(-np.inf, np.inf, (2,)),
                }
            ),
            action_space=spaces.Box(-np.inf, 3, (1,)),
        )
    return root


def test_a_minari_data_set_by_its_id(minari_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
    assert import_data("cart/push-v0", tmp_path / "data") == "it names no environment"
    dataset, given = Dataset(tmp_path / "data"), arrays()
    np.testing.assert_array_equal(dataset["observation"], given["observations"][8:])
    assert dataset.task.feature_names == ("position", "rest_0", "rest_1")
    assert dataset.task.id == "Minari-cart-push-v0"
    assert dataset.task.action_low == (given["actions"][8:].min(),)
    assert dataset.task.action_high == (3,)
    with pytest.raises(
        InputError, match=r"nothing to import at .* a Minari data set in .*: cart/push-v0"
    ):
        import_data("cart/pull-v0", tmp_path / "other")


def minari_copy(minari_folder, tmp_path, **changes):
    """A copy of the data set with other metadata."""
    folder = shutil.copytree(minari_folder / "cart/push-v0", tmp_path / "copy")
    path = folder / "data/metadata.json"
    metadata = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({n: v for n, v in metadata.items() if v is not None}))
    return str(folder)


@pytest.mark.parametrize(
    ("env_id", "expected"),
    [
        (PENDULUM, PENDULUM),
        ("MountainCarContinuous-v0", "Minari-cart-push-v0"),  # it has other sizes
        ("Carts/Cart-v3", "Carts/Cart-v3"),  # it isn't here, and gives the task its id
    ],
)
def test_an_environment_is_described_if_it_is_here_and_fits(
    env_id, expected, minari_folder, tmp_path
):
    spec = {"id": env_id, "kwargs": {}, "max_episode_steps": 50}
    folder = minari_copy(minari_folder, tmp_path, env_spec=json.dumps(spec))
    import_data(folder, tmp_path / "data")
    task = Dataset(tmp_path / "data").task
    assert (task.id, task.max_episode_steps) == (expected, 50)
    assert (task == describe(PENDULUM, episode_steps=50)) == (env_id == PENDULUM)


def test_no_code_that_a_minari_data_set_names_is_run(minari_folder, tmp_path, monkeypatch):
    """Minari makes the environment from its entry point where a space is missing."""
    (tmp_path / "evil.py").write_text("open('ran', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    spec = gymnasium.envs.registration.EnvSpec("Evil-v0", entry_point="evil:Env")
    changes = {"env_spec": spec.to_json(), "observation_space": None}
    with pytest.raises(InputError, match=r"metadata.json has no observation_space"):
        import_data(minari_copy(minari_folder, tmp_path, **changes), tmp_path / "data")
    assert not (tmp_path / "ran").exists()


def spoiled(name, place, value):
    values = arrays()[name]
    values[place] = value
    return {name: values}


BAD_ARRAYS = {  # words of the line that refuses them
    "row 3 observation": spoiled("observations", 3, np.nan),
    "reward 32 bits step": {"rewards": np.full(20, 1e39)},
    "20 observations 19 actions": {"actions": arrays()["actions"][1:]},
    "no actions": {"actions": None},
    "4 features 1 numbers Pendulum-v1 3": {
        "observations": np.zeros((20, 4)),
        "final_observations": np.zeros((3, 4)),
    },
    "action 0 2.5 [-2, 2]": spoiled("actions", 2, 2.5),
    "observations sizes": {"observations": [[1, 2, 3]] * 19 + [[1, 2]]},
    "action int64": {"actions": np.zeros((20, 1), int)},
    "terminated": {"terminations": np.arange(20) % 3},
    "no step two rows": {
        **{name: values[:1] for name, values in arrays().items()},
        "final_observations": None,
    },
    "final_observation 2 3": {"final_observations": arrays()["final_observations"][:2]},
    "seeds float64": {"seeds": [1, 2, np.nan]},
    "300 Pendulum-v1 200": arrays(lengths=(1, 1, 300)),
}


@pytest.mark.parametrize("words", BAD_ARRAYS)
def test_bad_arrays_are_refused_and_nothing_is_left(words, tmp_path):
    with pytest.raises(InputError) as caught:
        from_arrays(tmp_path / "data", **{**arrays(), **BAD_ARRAYS[words]}, task=PENDULUM)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words.split())
    assert not list(tmp_path.iterdir())


BAD_TABLES = {
    "episode 9 has step 6 where step 5": {"step": STEP + (np.arange(20) > 12)},
    "episode 4 goes on after its end": {"episode": np.where(np.arange(20) > 14, 4, EPISODE)},
    "row 0: correct 'joint 0'": {"joint 0": ["a"] * 20},
    "a.parquet, row 0: 'step'": {"step": [None, *range(19)]},
    "has no actions": {"action_0": None},
}


@pytest.mark.parametrize("problem", BAD_TABLES)
def test_bad_tables_are_refused(problem, tmp_path):
    path, changes = tmp_path / "a.parquet", BAD_TABLES[problem]
    plain_table(path)
    given = pq.read_table(path).to_pydict() | changes
    pq.write_table(pa.table({n: v for n, v in given.items() if v is not None}), path)
    with pytest.raises(InputError, match=re.escape(problem)):
        import_data(str(path), tmp_path / "data")
    assert list(tmp_path.iterdir()) == [path]


def of_other_files(file, elsewhere):
    """What an HDF5 file may have of other files."""
    episode = file["episode_0"]
    yield "a link", lambda: episode.__setitem__("rewards", h5py.ExternalLink(elsewhere, "x"))
    yield "a link", lambda: episode.__setitem__("rewards", h5py.SoftLink("/episode_0/actions"))
    yield (
        "in another file",
        lambda: episode.create_dataset("rewards", (12,), "<f8", external=[(elsewhere, 0, 96)]),
    )
    layout = h5py.VirtualLayout((12,), "<f8")
    layout[:] = h5py.VirtualSource(elsewhere, "x", (12,))
    yield "in another file", lambda: episode.create_virtual_dataset("rewards", layout)


@pytest.mark.parametrize("harm", range(4))
def test_a_minari_data_set_reads_nothing_outside_itself(harm, minari_folder, tmp_path):
    """A pipe that nobody fills would hang."""
    folder = Path(minari_copy(minari_folder, tmp_path))
    os.mkfifo(tmp_path / "pipe")
    (path,) = folder.rglob("*.hdf5")
    with h5py.File(path, "r+") as file:
        message, do = list(of_other_files(file, str(tmp_path / "pipe")))[harm]
        del file["episode_0"]["rewards"]
        do()
    with pytest.raises(InputError, match=message):
        import_data(str(folder), tmp_path / "data")


def test_a_minari_data_set_has_harmless_arguments(minari_folder, tmp_path):
    folder = Path(minari_copy(minari_folder, tmp_path))
    metadata = next(folder.rglob("metadata.json"))
    known = json.loads(metadata.read_text())
    for text in ("/etc/passwd", "pipe.xml"):
        spec = {"id": "Pendulum-v1", "kwargs": {"g": [{"a": text}]}, "max_episode_steps": 200}
        metadata.write_text(json.dumps({**known, "env_spec": json.dumps(spec)}))
        source = open_sources([str(folder)])
        assert source.task is None
        assert "may name files" in source.why_no_task


class Evil:
    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_nothing_in_an_npz_file_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    objects = np.array([Evil()] * 20, object)
    for name in ("rewards", "seeds", "infos"):
        d4rl("bad.npz", **{name: objects})
        with pytest.raises(InputError, match=r"bad\.npz: .*Object arrays"):
            import_data("bad.npz", tmp_path / "data")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.npz"]


def test_files_that_are_no_data_are_refused(tmp_path, minari_folder):
    for name in ("a.npz", "a.parquet", "a.pkl"):
        (tmp_path / name).write_bytes(b"nonsense" * 50)
    d4rl(tmp_path / "names.npz", feature_names=["one"])
    shutil.copytree(minari_folder / "cart/push-v0", tmp_path / "spoiled")
    (tmp_path / "spoiled/data/main_data.hdf5").write_bytes(b"nonsense")
    for name, problem in {
        "a.npz": "can't be imported",
        "a.parquet": "can't be read as a Parquet file",
        "a.pkl": "unknown format '.pkl'",
        "names.npz": "names of 1 numbers",
        "spoiled": "main_data.hdf5 can't be read as an HDF5 file",
    }.items():
        with pytest.raises(InputError, match=problem) as caught:
            import_data(str(tmp_path / name), tmp_path / "data")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "data").exists()


KILLED = """
import os, sys
from pathlib import Path
from jbrep.dataset.formats import open_sources, writer
def die(*arguments):
    os.kill(os.getpid(), 9)
writer.publish = die
writer.write(open_sources([sys.argv[1]]), Path(sys.argv[2]))
"""


def test_a_killed_import_is_done_again_by_the_same_command(tmp_path):
    d4rl(tmp_path / "a.npz")
    command = [sys.executable, "-c", KILLED, tmp_path / "a.npz", tmp_path / "data"]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert not (tmp_path / "data").exists()
    import_data(str(tmp_path / "a.npz"), tmp_path / "data")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "data"]


def test_damage_is_noticed_and_nothing_is_simulated_again(written, tmp_path):
    folder = shutil.copytree(written.folder, tmp_path / "copy")
    with pytest.raises(InputError, match=r"imported from pushes of a pole"):
        list(replay_problems(Dataset(folder), 1))
    flip_bit(shard_path(folder, 0), -8)
    assert len(list(find_problems(folder))) == 1
