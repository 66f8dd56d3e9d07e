"""HDF5 files of others: D4RL's layout and robomimic's, as their own tools write them."""

import h5py
import numpy as np
import pytest
from foreign import ROWS, imported, not_imported, write_d4rl, write_robomimic


def test_a_file_of_d4rl(tmp_path):
    _, data = imported(write_d4rl(tmp_path / "hopper_medium-v2.hdf5"))
    assert data.task.id == "hopper_medium-v2"
    assert data.task.feature_names == ("observations_0", "observations_1")
    assert data.episodes["length"].tolist() == [9, 7, 6]  # what the last steps led to isn't known
    names = ("--observations", "observations.0,infos/qpos", "--actions", "actions")
    _, wider = imported(tmp_path / "hopper_medium-v2.hdf5", *names, out="wider")
    assert wider.task.feature_names == ("observations_0", "qpos_0", "qpos_1", "qpos_2", "qpos_3")


def test_a_file_of_robomimic(tmp_path):
    _, data = imported(write_robomimic(tmp_path / "low_dim.hdf5"))
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
    names = ("--observations", "robot0_eef*", "--actions", "actions_abs", "--length", "4")
    _, few = imported(tmp_path / "low_dim.hdf5", *names, out="few")
    assert few.task.feature_names == ("robot0_eef_pos_0", "robot0_eef_pos_1")
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


IN_DEMOS = {  # words of the line that refuses it: the place and the column
    "demo_2 rewards (3,)": spoiled("rewards", rewards=np.zeros(3)),
    "demo_2 object (3, 3)": spoiled("obs/object", obs__object=np.zeros((3, 3))),
    "demo_2, step 1 object.1": lambda data: data["demo_2/obs/object"].write_direct(
        np.full((4, 3), np.nan), np.s_[1:2, 1:2], np.s_[1:2, 1:2]
    ),
    "episode 2 step 0": spoiled("next_obs/object", next_obs__object=np.zeros((4, 3))),
    "demo_2/dones link": spoiled("dones", dones=h5py.ExternalLink("/etc/x", "y")),
}


IN_ROWS = {
    "25 observations 24 rewards": {"rewards": np.zeros(24)},
    "row 3 observations.1": {
        "observations": np.where([[0, i == 3] for i in range(ROWS)], np.inf, 1)
    },
    "neither actions": {"actions": None},
    "row 3": {"terminals": np.where(np.arange(ROWS) == 3, np.nan, np.arange(ROWS) == 9)},
}


@pytest.mark.parametrize("words", [*IN_DEMOS, *IN_ROWS])
def test_what_is_wrong_in_a_file_is_told_with_its_place(words, tmp_path):
    path = tmp_path / "a.hdf5"
    if words in IN_DEMOS:
        told = not_imported(write_robomimic(path, damage=IN_DEMOS[words]))
    else:
        told = not_imported(write_d4rl(path, **IN_ROWS[words]))
    assert all(word in told for word in words.split())
