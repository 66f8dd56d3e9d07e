"""HDF5 files of others: D4RL's layout and robomimic's, as their own tools write them."""

import zlib

import h5py
import numpy as np
import pytest
from command import jbrep
from foreign import ROWS, STEPS, write_d4rl, write_robomimic

from jbrep.dataset import Dataset
from jbrep.dataset.verify import find_problems


def imported(path, *options, out="data"):
    done = jbrep("data", "import", path, *options, "--out", path.parent / out)
    assert done.exit_code == 0, done.output
    assert not list(find_problems(path.parent / out))
    return done.output, Dataset(path.parent / out)


def test_a_file_of_d4rl(tmp_path):
    told, data = imported(write_d4rl(tmp_path / "hopper_medium-v2.hdf5"))
    assert data.task.id == "hopper_medium-v2"
    assert data.task.feature_names == ("observations_0", "observations_1")
    assert data.episodes["length"].tolist() == [9, 7, 6]  # what the last steps led to isn't known
    np.testing.assert_array_equal(data["reward"][:9], np.arange(9))
    assert "25 rows read" in told
    assert "not used: infos/qpos" in told
    assert "not a row for each step: metadata/policy/fc0/weight" in told
    names = ("--observations", "observations.0,infos/qpos", "--actions", "actions")
    _, wider = imported(tmp_path / "hopper_medium-v2.hdf5", *names, out="wider")
    assert wider.task.feature_names == ("observations_0", "qpos_0", "qpos_1", "qpos_2", "qpos_3")


def test_what_came_after_each_action_keeps_the_last_steps(tmp_path):
    after = np.stack([STEPS + 1, np.repeat(range(3), (10, 8, 7))], 1).astype(np.float32)
    path = write_d4rl(tmp_path / "a.h5", next_observations=after)
    _, data = imported(path)
    assert data.episodes["length"].tolist() == [10, 8, 7]
    assert data.episodes["terminated"].tolist() == [1, 0, 0]
    assert data.episodes["final_observation"].tolist() == [[10, 0], [8, 1], [7, 2]]
    _, few = imported(path, "--observations", "observations.0", out="few")
    assert few.episodes["final_observation"].tolist() == [[10], [8], [7]]


def test_angles_are_brought_to_rad_after_each_action_too(tmp_path):
    now = np.stack([40.0 * STEPS, np.repeat(range(3), (10, 8, 7))], 1).astype(np.float32)
    after = now + np.array([40, 0], np.float32)
    path = write_d4rl(tmp_path / "a.h5", observations=now, next_observations=after)
    names = ("--observations", "observations.0", "--angles", "observations.0")
    _, data = imported(path, *names, "--units", "observations=deg")
    turned = np.radians(40 * np.arange(10))
    np.testing.assert_allclose(
        np.exp(1j * data["observation"][:10, 0]), np.exp(1j * turned), atol=1e-5
    )
    assert data.episodes["length"].tolist() == [10, 8, 7]


def test_a_file_of_robomimic(tmp_path):
    told, data = imported(write_robomimic(tmp_path / "low_dim.hdf5"))
    assert (data.task.id, data.task.timestep) == ("Lift", 1 / 20)
    assert data.task.feature_names == (
        *("object_0", "object_1", "object_2", "robot0_eef_pos_0", "robot0_eef_pos_1"),
        "robot0_gripper",
    )
    assert data.episodes["length"].tolist() == [6, 5, 4, *[3] * 8]
    assert np.asarray(data["object_2"])[-1] == 10 / 8  # demo_10 comes after demo_9
    assert data.episodes["terminated"].all()
    assert data.episodes["final_observation"][1].tolist() == pytest.approx(
        [5 / 8, 25 / 8, 1 / 8, 0.5, 1, 5]
    )
    assert data.episodes["return"].tolist() == [1] * 11
    for line in (
        "1 step done before the end of a demo: the episode goes on there",
        "images are left out: agentview_image, next_obs/agentview_image",
        "not used: actions_abs, states",
    ):
        assert line in told
    names = ("--observations", "robot0_eef*", "--actions", "actions_abs", "--length", "4")
    _, few = imported(tmp_path / "low_dim.hdf5", *names, out="few")
    assert few.task.feature_names == ("robot0_eef_pos_0", "robot0_eef_pos_1")
    assert few.task.action_high[0] > 1
    assert few.episodes["length"].tolist() == [4, 2, 4, 1, 4, *[3] * 8]


def test_what_was_done_before_is_observed_and_is_no_action(tmp_path):
    def with_last_actions(data):
        for demo in data.values():
            done = np.asarray(demo["actions"])
            demo["obs/actions"] = np.concatenate((0 * done[:1], done[:-1]))
            demo["next_obs/actions"] = done

    path = write_robomimic(tmp_path / "a.hdf5", damage=with_last_actions)
    _, data = imported(path)
    assert data.task.feature_names[:7] == tuple(f"actions_{i}" for i in range(7))
    actions, observed = np.asarray(data["action"]), np.asarray(data["observation"])[:, :7]
    np.testing.assert_array_equal(observed[1:6], actions[:5])
    assert not observed[0].any()


def spoiled(*names, **values):
    def damage(data):
        demo = data["demo_2"]
        for name in names:
            del demo[name]
        for name, each in values.items():
            demo[name.replace("__", "/")] = each

    return damage


IN_DEMOS = {
    "a.hdf5, data/demo_2 has 4 rows of actions, and 3 of rewards": spoiled(
        "rewards", rewards=np.zeros(3)
    ),
    "a.hdf5, data/demo_2, step 0: no 'object'": spoiled("obs/object"),
    "step 0: float64 of shape (2,) in 'object', unlike before": spoiled(
        "obs/object", obs__object=np.zeros((4, 2))
    ),
    "a.hdf5, data/demo_2, step 1: 'object.1' is empty, or no finite number": lambda data: data[
        "demo_2/obs/object"
    ].write_direct(np.full((4, 3), np.nan), np.s_[1:2, 1:2], np.s_[1:2, 1:2]),
    "data/demo_2 has 4 rows of actions, and 3 of obs/object rows": spoiled(
        "obs/object", obs__object=np.zeros((3, 3))
    ),
    "data/demo_2 has dones of shape (2,) in each row": spoiled("dones", dones=np.zeros((4, 2))),
    "has no column 'obs/': it has actions.0": lambda data: data["demo_0"].pop("obs"),
    "episode 2 has a gap after step 0": spoiled(
        "next_obs/object", next_obs__object=np.zeros((4, 3))
    ),
    "data/demo_2/more would have": lambda data: data.create_dataset(
        "demo_2/more", (1 << 40,), "<f8", chunks=(9,)
    ),
    "data/demo_2/dones is a link": spoiled("dones", dones=h5py.ExternalLink("/etc/x", "y")),
}


@pytest.mark.parametrize("problem", IN_DEMOS)
def test_what_is_wrong_in_a_demo_is_told_with_its_place(problem, tmp_path):
    path = write_robomimic(tmp_path / "a.hdf5", damage=IN_DEMOS[problem])
    check_refused(path, problem)


IN_ROWS = {
    "has 25 rows of observations, and 24 of rewards": {"rewards": np.zeros(24)},
    "row 3: 'observations.1' is empty, or no finite number": {
        "observations": np.where([[0, i == 3] for i in range(ROWS)], np.inf, 1)
    },
    "has a terminated that is neither true nor false": {"terminals": STEPS},
    "has neither observations and actions, as D4RL's": {"actions": None},
    "has int64 in the column 'actions'": {"actions": STEPS},
    "has images, observations of shape (8, 8, 3)": {
        "observations": np.zeros((ROWS, 8, 8, 3), np.uint8)
    },
}


@pytest.mark.parametrize("problem", IN_ROWS)
def test_what_is_wrong_in_rows_is_told_with_its_place(problem, tmp_path):
    check_refused(write_d4rl(tmp_path / "a.hdf5", **IN_ROWS[problem]), problem)


def test_what_is_no_hdf5_is_refused(tmp_path):
    path = write_d4rl(tmp_path / "a.hdf5")
    content = path.read_bytes()
    for damaged in (b"nonsense" * 50, content[: len(content) // 2]):
        path.write_bytes(damaged)
        check_refused(path, "a.hdf5 can't be read as an HDF5 file")


def squeezed(content, times):
    for _ in range(times):
        content = zlib.compress(content)
    return content


@pytest.mark.parametrize(
    ("times", "problem"),
    [
        (1, " bytes for a chunk of 200"),
        (2, "observations has filters other than deflate or lzf, once, and shuffle and fletcher"),
    ],
)
def test_a_chunk_holds_no_more_than_it_says(times, problem, tmp_path):
    path = write_d4rl(tmp_path / "a.hdf5", observations=None)
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((ROWS, 2))
    for _ in range(times):
        settings.set_deflate(9)
    with h5py.File(path, "r+") as file:
        space = h5py.h5s.create_simple((ROWS, 2))
        array = h5py.h5d.create(file.id, b"observations", h5py.h5t.NATIVE_FLOAT, space, settings)
        array.write_direct_chunk((0, 0), squeezed(bytes(10_000_000), times))
    check_refused(path, problem)


def test_a_file_may_be_squeezed_and_shuffled(tmp_path):
    path = write_d4rl(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as file:
        for name, by in (("observations", "gzip"), ("rewards", "lzf")):
            values = file.pop(name)[:]
            file.create_dataset(name, data=values, compression=by, shuffle=True, fletcher32=True)
    assert imported(path)[1].episodes["length"].tolist() == [9, 7, 6]


def check_refused(path, problem):
    """In a line, and nothing is left."""
    done = jbrep("data", "import", path, "--out", path.parent / "out")
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.stderr
    assert problem in done.stderr
    assert [each.name for each in path.parent.iterdir()] == [path.name]
