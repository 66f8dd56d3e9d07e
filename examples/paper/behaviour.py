"""How policies turn the motor and where they go: the paper's Fig. 4 and 5.

    python examples/paper/behaviour.py runs/full runs/dae-4 --out behaviour
    python examples/paper/behaviour.py heuristic uniform --task move_in_direction --out behaviour

A policy is the folder of a run, shown before and after training; a folder with several runs, which
count as one; or a name, with its --task. All play the same episodes, with the target in one place.
Written are motor_velocity and positions, each as CSV and PNG.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from jbrep.envs import describe
from jbrep.envs.environments import Environments
from jbrep.envs.task import Task
from jbrep.jitterbug.tasks import jitterbug_task
from jbrep.play.player import Player
from jbrep.play.sources import as_player, find_player, is_by_name
from jbrep.rl.checkpoint import read_header
from jbrep.rl.files import BEGINNING, FINISHED, RUN, is_run, read_run, runs_below
from jbrep.rl.policy import Trained, build, run_encoder
from jbrep.rl.policy_file import read

SPEEDS = np.linspace(-180, 180, 73)  # edges of the bins of the motor's velocity [rad/s]
FAST = 30.0  # of the motor, either way [rad/s]
CELL = 0.02  # edge of a cell of the floor [m]
BATCH = 20  # episodes that are held in memory at once
ACROSS = 4  # panels of the floor in a row, at most


class Visits(NamedTuple):
    """What one policy, or several that count as one, did in n states of some episodes."""

    returns: NDArray[np.float64]  # (episodes,)
    motor: NDArray[np.float64]  # its velocity, (n,) [rad/s]
    place: NDArray[np.float64]  # x and y, (n, 2) [m]


def find(sources: Sequence[str], task: Task | None) -> dict[str, list[Player]]:
    """The players that each panel shows, by its title."""
    found: dict[str, list[Player]] = {}
    folders = [str(Path(each).absolute().parent) for each in sources if not is_by_name(each)]
    shared = os.path.commonpath(folders) if folders else ""
    for source in sources:
        if is_by_name(source):
            found[source] = [find_player(source, task)]
            continue
        folder, name = Path(source), os.path.relpath(source, shared)
        runs = [folder] if is_run(folder) else runs_below(folder)
        if not is_run(folder):  # those that failed have no policy
            runs = [run for run in runs if read_run(run).status == FINISHED]
        after = [find_player(str(run), task) for run in runs]
        before = f"{name}, before training"
        found[before] = [as_player(before, untrained(run), task) for run in runs]
        found[f"{name}, {len(runs)} runs" if len(runs) > 1 else name] = after
    return found


def untrained(folder: Path) -> Trained:
    """The policy that a run began with."""
    known = read_run(folder) if (folder / RUN).exists() else read_header(folder)
    settings = known.settings
    built = build(settings, run_encoder(folder, settings), folder)
    if settings.begin_from is None:
        return built
    policy = read(folder / BEGINNING, settings.begin_from)
    return built.with_weights(policy.weights, policy.tensors, policy.path)


def turn_targets(envs: Environments, yaw: float) -> None:
    """Turn the target of every environment to that yaw [rad], at the start of its episode."""
    simulation = envs.instances.simulation
    turned = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    targets = {"target_quaternion": np.tile(turned, (envs.num_envs, 1))}
    simulation.restore(**simulation.state | targets)
    envs.observation = simulation.observe()


def watch(players: Sequence[Player], episodes: int, target_yaw: float) -> Visits:
    """What they do in the first so many of the episodes that every run is evaluated on."""
    returns, motor, place = [], [], []
    for player in players:
        if jitterbug_task(player.task) is None:
            raise SystemExit(f"{player.name}: only the Jitterbug's tasks have its motor")
        for first in range(0, episodes, BATCH):
            some = range(first, min(first + BATCH, episodes))
            for each in player.play(some, lambda envs: turn_targets(envs, target_yaw)):
                returns.append(each.episode_return)
                motor.append(each.motion.arrays["qvel"][:, -1].copy())  # a view would keep all
                place.append(each.motion.qpos[:, :2].copy())
    return Visits(np.array(returns), np.concatenate(motor), np.concatenate(place))


def motor_table(played: dict[str, Visits]) -> pd.DataFrame:
    """Share of time in each bin of the motor's velocity."""
    shares = {}
    for name, visits in played.items():
        counts, _ = np.histogram(visits.motor.clip(SPEEDS[0], SPEEDS[-1]), SPEEDS)
        bins = {"low": SPEEDS[:-1], "high": SPEEDS[1:], "share": counts / counts.sum()}
        shares[name] = pd.DataFrame(bins)
    return pd.concat(shares, names=["policy"]).reset_index("policy")


def place_table(played: dict[str, Visits]) -> pd.DataFrame:
    """Share of time in each cell of the floor that was visited, by its centre [m]."""
    shares = {}
    for name, visits in played.items():
        cells, counts = np.unique(np.floor(visits.place / CELL), axis=0, return_counts=True)
        x, y = ((cells + 0.5) * CELL).T
        shares[name] = pd.DataFrame({"x": x, "y": y, "share": counts / counts.sum()})
    return pd.concat(shares, names=["policy"]).reset_index("policy")


def draw_motor(table: pd.DataFrame, played: dict[str, Visits], out: Path) -> None:
    """A panel for each policy, with a scale of its own: some stand still most of the time."""
    size = (3.4, 0.65 + 0.85 * len(played))
    figure, panels = plt.subplots(
        len(played), sharex=True, squeeze=False, figsize=size, layout="constrained"
    )
    for axes, (name, visits) in zip(panels[:, 0], played.items(), strict=True):
        axes.stairs(100 * table[table.policy == name].share, SPEEDS, fill=True, alpha=0.75)
        axes.set_title(f"{name}: return {np.median(visits.returns):.0f}", size=8)
        axes.set_ylabel("time [%]")
    panels[-1, 0].set_xlabel("motor velocity [rad/s]")
    figure.savefig(out, dpi=200)


def draw_places(
    table: pd.DataFrame, played: dict[str, Visits], target_yaw: float, out: Path
) -> None:
    """A floor for each policy; an arrow points in the target's direction."""
    rows = -(-len(played) // ACROSS)
    across = -(-len(played) // rows)
    grid = {"squeeze": False, "sharex": True, "sharey": True, "layout": "constrained"}
    figure, panels = plt.subplots(rows, across, figsize=(7, 0.6 + 2.2 * rows), **grid)
    cells = int(np.ceil(table[["x", "y"]].abs().to_numpy().max() / CELL))
    edges = CELL * np.arange(-cells, cells + 1)
    norm = LogNorm(table.share.min(), table.share.max())
    ordered = panels.ravel(order="F")  # before and after training are one above the other
    for axes in ordered[len(played) :]:
        axes.set_axis_off()
    for axes, (name, visits) in zip(ordered, played.items(), strict=False):
        own = table[table.policy == name]
        shares, *_ = np.histogram2d(own.x, own.y, (edges, edges), weights=own.share)
        shown = np.ma.masked_equal(shares.T, 0)
        mesh = axes.pcolormesh(edges, edges, shown, norm=norm)
        axes.plot(0, 0, "o", color="black", mfc="none")  # where episodes begin
        tip = 0.95 * edges[-1] * np.array([np.cos(target_yaw), np.sin(target_yaw)])
        axes.annotate("", tip, 0.7 * tip, arrowprops={"arrowstyle": "-|>"})
        axes.set_title(f"{name}\nreturn {np.median(visits.returns):.0f}", size=7)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axes.label_outer()
    figure.colorbar(mesh, ax=panels, label="share of time")
    figure.savefig(out, dpi=200)


def main() -> None:
    """Write the tables and figures, and print a line for each policy."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--task", help="of policies by name")
    parser.add_argument("--episodes", type=int, default=100, help="of each run or policy")
    parser.add_argument("--target-yaw", type=float, default=45.0, help="of all targets [degrees]")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    yaw = np.deg2rad(given.target_yaw)
    players = find(given.policies, describe(given.task) if given.task else None)
    played = {name: watch(each, given.episodes, yaw) for name, each in players.items()}
    given.out.mkdir(parents=True, exist_ok=True)
    motor, places = motor_table(played), place_table(played)
    for name, table in (("motor_velocity", motor), ("positions", places)):
        table.to_csv(given.out / f"{name}.csv", index=False)
    draw_motor(motor, played, given.out / "motor_velocity.png")
    draw_places(places, played, yaw, given.out / "positions.png")
    for name, visits in played.items():
        low, median, high = np.percentile(visits.returns, (10, 50, 90))
        back, forth = (visits.motor < -FAST).mean(), (visits.motor > FAST).mean()
        x, y = visits.place.mean(axis=0)
        print(
            f"{name}: return {median:.0f} [{low:.0f}, {high:.0f}]; motor faster than {FAST:g} "
            f"rad/s {back:.0%} of the time one way, {forth:.0%} the other; mean place "
            f"{x:.2f}, {y:.2f} m"
        )


if __name__ == "__main__":
    main()
