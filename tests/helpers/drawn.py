"""Logs of which everything is known, in a form that is drawn by a seed."""

import json
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import h5py
import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.parquet as pq
from foreign import open_bag, write_lerobot

START = datetime(2026, 3, 14, 11, 59, 58, tzinfo=UTC)
SEPARATORS = (",", ";", "\t", "|")
STAMPS = {  # the time of a row: its cell, and the unit that its column says
    "s": lambda t: (f"{t:.3f}", "s"),
    "whole": lambda t: (f"{t:g}", "s"),
    "ms": lambda t: (f"{1000 * t:.0f}", "ms"),
    "ns": lambda t: (str(1_700_000_000_000_000_000 + round(t * 1e9)), "ns"),
    "iso": lambda t: (at(t).isoformat(" ", "milliseconds").removesuffix("+00:00"), ""),
    "T": lambda t: (at(t).isoformat("T", "microseconds"), ""),
    "Z": lambda t: (at(t).isoformat("T", "milliseconds").replace("+00:00", "Z"), ""),
    "short zone": lambda t: (at(t).isoformat(" ", "milliseconds").replace("+00:00", "+00"), ""),
    "comma": lambda t: (at(t).isoformat(" ", "milliseconds")[:-6].replace(".", ","), ""),
}


def at(seconds):
    """A time of day."""
    return START + timedelta(seconds=round(seconds, 6))


class Truth(NamedTuple):
    """Episodes of n steps each; numbers have three decimals."""

    timestep: float  # [s]
    seen: list  # (n + 1, d)
    actions: list  # (n, k)
    rewards: list  # (n,)

    @classmethod
    def drawn(cls, random):
        """Draw some."""
        d, k, episodes = random.integers(1, 5), random.integers(1, 3), random.integers(1, 5)
        lengths = random.integers(2, 25, episodes).tolist()

        def some(*shape):
            return random.uniform(-9, 9, shape).round(3)

        return cls(
            float(random.choice([0.01, 0.02, 0.05, 0.1])),
            [some(n + 1, d) for n in lengths],
            [some(n, k) for n in lengths],
            [some(n) for n in lengths],
        )

    @property
    def features(self):
        """Their names."""
        return [f"x{i}" for i in range(self.seen[0].shape[1])]

    @property
    def commands(self):
        """Names of the numbers of an action."""
        return [f"u{i}" for i in range(self.actions[0].shape[1])]

    def times(self, pause=5.0):
        """Of the rows of each episode [s], the last one with the final observation."""
        starts = np.cumsum([0.0, *((len(each) - 1) * self.timestep + pause for each in self.seen)])
        return [
            begin + self.timestep * np.arange(len(each))
            for begin, each in zip(starts, self.seen, strict=False)
        ]

    def columns(self, pause=5.0):
        """A row for each observation; what isn't known after the last action is 0."""
        trial = np.repeat(range(len(self.seen)), [len(each) for each in self.seen])
        padded = [np.vstack((each, np.zeros((1, each.shape[1])))) for each in self.actions]
        columns = {"t": np.concatenate(self.times(pause)).round(6)}
        columns |= dict(zip(self.features, np.concatenate(self.seen).T, strict=True))
        columns |= dict(zip(self.commands, np.concatenate(padded).T, strict=True))
        columns["gain"] = np.concatenate([np.append(each, 0) for each in self.rewards])
        return columns | {"trial": trial}

    def check(self, data, has_rewards=True, has_clock=True):
        """Compare a data set, to the bit."""
        assert data.episodes["length"].tolist() == [len(each) for each in self.actions]
        seen = np.concatenate([each[:-1] for each in self.seen])
        assert np.array_equal(data["observation"][:], seen.astype(np.float32))
        final = np.stack([each[-1] for each in self.seen])
        assert np.array_equal(data.episodes["final_observation"], final.astype(np.float32))
        assert np.array_equal(data["action"][:], np.concatenate(self.actions).astype(np.float32))
        if has_rewards:
            rewards = np.concatenate(self.rewards).astype(np.float32)
            assert np.array_equal(data["reward"][:], rewards)
        if has_clock:
            assert np.isclose(data.task.timestep, self.timestep, rtol=1e-3)

    def options(self):
        """What to say of the columns."""
        names = "--observations", ",".join(self.features), "--actions", ",".join(self.commands)
        return *names, "--time", "t", "--reward", "gain"


def text(truth, random, path):  # noqa: C901
    """Text; what to say of it."""
    separator = str(random.choice(SEPARATORS))
    mark = str(random.choice([".", ","])) if separator != "," else "."
    stamp = str(random.choice(list(STAMPS)))
    ends = str(random.choice(["words", "numbers", "gap", "back"]))
    units = str(random.choice(["no", "header", "round", "line", "line in brackets"]))
    if stamp == "comma" and separator == ",":
        stamp = "iso"
    columns = truth.columns()
    trial = columns.pop("trial")
    if ends == "back":
        columns["t"] = np.concatenate([each - each[0] for each in truth.times()]).round(6)
    told = dict.fromkeys(columns, "m/s") | {"gain": ""}
    cells = {name: [f"{v:.3f}".replace(".", mark) for v in each] for name, each in columns.items()}
    stamped = [STAMPS[stamp](t) for t in columns["t"]]
    cells["t"], told["t"] = [cell for cell, _ in stamped], stamped[0][1]
    if stamp in ("s", "whole"):
        cells["t"] = [cell.replace(".", mark) for cell in cells["t"]]
    options = list(truth.options())
    if ends in ("words", "numbers"):
        cells["trial"], told["trial"] = (
            [f"run {i}" if ends == "words" else f"{i}" for i in trial],
            "",
        )
        options += ["--episode", "trial"]
    elif ends == "gap":
        options += ["--gap", "2"]
    said = {"header": "{} [{}]", "round": "{} ({})"}.get(units, "{}")
    header = [said.format(name, told[name]) if told[name] else name for name in cells]
    lines = [header, *map(list, zip(*cells.values(), strict=True))]
    if units.startswith("line"):
        put = "[{}]" if "brackets" in units else "{}"
        lines.insert(1, [put.format(told[name]) if told[name] else "" for name in cells])
    elif units == "no" and told["t"] not in ("s", ""):
        options += ["--units", f"t={told['t']}"]
    if random.random() < 0.3:
        lines = [[f'"{cell}"' for cell in line] for line in lines]
    rows = [separator.join(line) for line in lines]
    if random.random() < 0.3:
        rows.insert(0, f"sep={separator}")
    elif random.random() < 0.5:
        rows[:0] = ["# a comment, with; marks", "% another"]
    end = str(random.choice(["\n", "\r\n"]))
    encoding = str(random.choice(["utf-8", "utf-8-sig"]))
    path = path.with_suffix(str(random.choice([".csv", ".txt", ".tsv"])))
    path.write_bytes((end.join(rows) + end).encode(encoding))
    return path, options, {}


def parquet(truth, random, path):
    """A Parquet file; what to say of it."""
    columns, options = truth.columns(), list(truth.options())
    kind = random.choice(["float", "stamp", "duration"])
    if kind == "stamp":
        columns["t"] = pa.array([at(t) for t in columns["t"]], pa.timestamp("us", "UTC"))
    elif kind == "duration":
        columns["t"] = pa.array((columns["t"] * 1e6).round().astype(int), pa.duration("us"))
    if random.random() < 0.5:
        columns["trial"] = [f"run {i}" for i in columns["trial"]]
    path = path.with_suffix(".parquet")
    pq.write_table(pa.table(columns), path, row_group_size=int(random.integers(1, 50)))
    return path, [*options, "--episode", "trial"], {}


def npz(truth, random, path):
    """Arrays by Gymnasium's names."""
    path = path.with_suffix(".npz")
    np.savez(path, **_steps(truth, random))
    return path, [], {"has_clock": False}


def d4rl(truth, random, path):
    """D4RL's arrays."""
    arrays = _steps(truth, random)
    arrays["terminals"], arrays["timeouts"] = arrays.pop("terminations"), arrays.pop("truncations")
    path = path.with_suffix(".hdf5")
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path, [], {"has_clock": False}


def _steps(truth, random):
    ends = np.concatenate([np.arange(len(a)) == len(a) - 1 for a in truth.actions])
    terminal = np.repeat(random.random(len(truth.actions)) < 0.5, [len(a) for a in truth.actions])
    return {
        "observations": np.concatenate([each[:-1] for each in truth.seen]),
        "next_observations": np.concatenate([each[1:] for each in truth.seen]),
        "actions": np.concatenate(truth.actions),
        "rewards": np.concatenate(truth.rewards),
        "terminations": ends & terminal,
        "truncations": ends & ~terminal,
    }


def robomimic(truth, random, path):
    """Robomimic's demos."""
    path, dt = path.with_suffix(".hdf5"), truth.timestep
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for i in random.permutation(len(truth.actions)).tolist():
            demo, seen = data.create_group(f"demo_{i}"), truth.seen[i]
            for j, name in enumerate(truth.features):
                demo[f"obs/{name}"], demo[f"next_obs/{name}"] = seen[:-1, j], seen[1:, j]
            demo["actions"], demo["rewards"] = truth.actions[i], truth.rewards[i]
            demo["dones"] = (np.arange(len(truth.actions[i])) == len(truth.actions[i]) - 1) * 1
        told = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": round(1 / dt)}}
        data.attrs["env_args"] = json.dumps(told)
    return path, [], {}


def lerobot(truth, random, path):
    """LeRobot's folder; it has no final observations, so that the last step of each is left out."""
    lengths = [len(each) for each in truth.seen]
    step = np.concatenate([np.arange(n) for n in lengths])
    columns = truth.columns()
    state = np.stack([columns[name] for name in truth.features], axis=1)
    action = np.stack([columns[name] for name in truth.commands], axis=1)
    rows = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32(), state.shape[1])),
        "action": pa.array(action.tolist(), pa.list_(pa.float32())),
        "next.reward": pa.array(columns["gain"].astype(np.float32)),
        "timestamp": pa.array((step * truth.timestep).astype(np.float32)),
        "frame_index": step,
        "episode_index": columns["trial"],
    }
    cut = int(random.integers(0, len(step) + 1))
    known = {
        "observation.state": {"dtype": "float32", "shape": [state.shape[1]], "names": None},
        "action": {"dtype": "float32", "shape": [action.shape[1]], "names": None},
    }
    info = {"codebase_version": "v3.0", "fps": round(1 / truth.timestep), "features": known}
    return write_lerobot(path, rows, cut, info), [], {}


def bag(truth, random, path):
    """A bag whose topics have a message at each step, the action's as long after as drawn."""
    kind = str(random.choice(["bag", "mcap", "db3"]))
    path = path.with_suffix(".bag") if kind == "bag" else path
    store, writer, pack = open_bag(path, kind)
    number = store.types["std_msgs/msg/Float64"]
    topics = [*truth.features, *truth.commands, "gain"]
    columns = truth.columns()
    goes_back = bool(random.random() < 0.5)
    times = [each - each[0] for each in truth.times()] if goes_back else truth.times()
    with writer:
        made = {
            name: writer.add_connection(f"/{name}", number.__msgtype__, typestore=store)
            for name in topics
        }
        stamps = 1_700_000_000_000_000_000 + (np.concatenate(times) * 1e9).round().astype(int)
        for row, stamp in enumerate(stamps.tolist()):
            for name in topics:
                message = number(float(columns[name][row]))
                writer.write(made[name], stamp, pack(message, number.__msgtype__))
    rate = f"{1 / truth.timestep:g}"
    names = ",".join(f"/{name}.data" for name in truth.features)
    commands = ",".join(f"/{name}.data" for name in truth.commands)
    options = ["--observations", names, "--actions", commands, "--reward", "/gain.data"]
    return path, [*options, "--rate", rate, "--gap", "2"], {}


FILES = {each.__name__: each for each in (text, parquet, npz, d4rl, robomimic, lerobot, bag)}


def frame(truth, random):
    """A data frame of pandas or polars."""
    columns = truth.columns()
    made = {name: columns[name] for name in random.permutation(list(columns)).tolist()}
    words = [f"run {i}" for i in columns["trial"]]
    if random.random() < 0.5:
        table = pandas.DataFrame(made)
        kind = str(random.choice(["int", "words", "category", "string"]))
        if kind != "int":
            table["trial"] = pandas.Series(words).astype({"words": object}.get(kind, kind))
        return table
    table = polars.DataFrame(made)
    kinds = {"int": None, "words": polars.String, "category": polars.Categorical}
    kinds["enum"] = polars.Enum(list(dict.fromkeys(words)))
    kind = str(random.choice(list(kinds)))
    if kinds[kind] is not None:
        table = table.with_columns(polars.Series("trial", words).cast(kinds[kind]))
    return table
