"""Everything that one can bring: an encoder, data, and the policy of a run to collect with.

python examples/own/own.py OUT walks through it on the Jitterbug and on Pendulum, in a minute, where
`make setup` has installed everything: it needs the extras.
"""

import os
import shlex
import sys
from pathlib import Path

import gymnasium
import minari
import numpy as np
import torch
from minari.data_collector import EpisodeBuffer
from net import Net
from torch import nn

from jbrep.cli import main
from jbrep.dataset import Dataset
from jbrep.encoders import load

STUDY = """
tasks = ["face_direction"]
algorithms = ["a2c-modern"]
seeds = 2
steps = 240
evaluate_every = 120
evaluation_episodes = 2
episode_steps = 100
representations = [
    { name = "mine", code = "net:trained" },
    { name = "mine-onnx", file = "mine.safetensors" },
]
"""


def jbrep(command: str) -> None:
    """Run a command of jbrep's, as a shell would."""
    print(f"\n$ jbrep {command}", flush=True)
    main(shlex.split(command), standalone_mode=False)


def train_elsewhere(data: Dataset) -> Net:
    """Train a module in plain PyTorch: its latent is to tell how the robot moves next."""
    torch.manual_seed(0)
    before = torch.from_numpy(np.asarray(data["observation"]))
    goes_on = torch.from_numpy(np.asarray(data["step"][1:]) > 0)
    now, change = before[:-1][goes_on], (before[1:] - before[:-1])[goes_on]
    net = Net(before.shape[1], 8)
    net.mean, net.deviation = before.mean(0), before.std(0)
    head = nn.Linear(8, before.shape[1])
    optimizer = torch.optim.Adam([*net.parameters(), *head.parameters()], lr=3e-3)
    target = change / change.std(0)
    for _ in range(200):
        optimizer.zero_grad()
        nn.functional.mse_loss(head(net(now)), target).backward()
        optimizer.step()
    return net.eval()


def encoder() -> None:
    """A module through evaluation, study, report and recording; as a file by way of ONNX, too."""
    jbrep("collect --task face_direction --episode-steps 100 --steps 2k --out states")
    net = train_elsewhere(Dataset("states"))
    torch.save(net.state_dict(), "net.pt")
    example = torch.zeros(2, len(net.mean))
    rows = {"observation": {0: torch.export.Dim("rows")}}
    torch.onnx.export(
        net, (example,), "net.onnx", input_names=["observation"], dynamic_shapes=rows, verbose=False
    )
    jbrep("encoder import net.onnx --task face_direction --name mine-onnx --out mine.safetensors")
    jbrep("evaluate --encoder net:trained --encoder mine.safetensors --data states")
    Path("study.toml").write_text(STUDY)
    jbrep("study study.toml --import net --workers 1 --out study")
    rows = np.asarray(Dataset("states")["observation"])
    codes = net(torch.from_numpy(rows)).detach().numpy()
    np.testing.assert_allclose(load(Path("mine.safetensors"))(rows), codes, rtol=1e-4, atol=1e-5)
    print("\nthe module and the file from ONNX give equal codes")
    run = "study/runs/face_direction/a2c-modern/mine/seed-0"
    jbrep(f"inspect {run} --out mine.rrd")


def record(env: gymnasium.Env, seed: int) -> EpisodeBuffer:
    """An episode of random actions, as Minari keeps it."""
    observation, _ = env.reset(seed=seed)
    steps, ended = [], False
    while not ended:
        action = env.action_space.sample()
        before, (observation, reward, terminated, truncated, _) = observation, env.step(action)
        steps.append((before, action, reward, terminated, truncated))
        ended = terminated or truncated
    observations, actions, *others = map(np.array, zip(*steps, strict=True))
    return EpisodeBuffer(
        None, seed, None, np.append(observations, [observation], 0), actions, *others
    )


def data() -> None:
    """A Minari data set comes in, an encoder goes out."""
    os.environ["MINARI_DATASETS_PATH"] = str(Path("minari").resolve())
    env = gymnasium.make("Pendulum-v1")
    env.action_space.seed(0)
    episodes = [record(env, seed) for seed in range(5)]
    minari.create_dataset_from_buffers("pendulum/mine-v0", episodes, env, algorithm_name="uniform")
    jbrep("data import pendulum/mine-v0 --out pendulum")
    jbrep("data verify pendulum")
    jbrep("train-encoder --kind pca --data pendulum --latent 2 --out pendulum-encoders")


def policies() -> None:
    """What a trained run visits, and an encoder of that; a data set that grows."""
    jbrep("rl --task Pendulum-v1 --algorithm a2c --set learning_rate=1e-3 --steps 4k --out run")
    jbrep("collect --task Pendulum-v1 --policy uniform:0.5+run:0.5 --steps 2k --out mixed")
    jbrep("train-encoder --kind pca --data mixed --latent 2 --out mixed-encoders")
    for steps, folder in (("1k", "grown"), ("2k", "grown"), ("2k", "at-once")):
        jbrep(f"collect --task face_direction --steps {steps} --out {folder}")
    for file in sorted(Path("at-once").glob("[!.]*")):
        assert file.read_bytes() == (Path("grown") / file.name).read_bytes(), file
    print("\nthe data set that has grown equals the one collected at once, to the byte")


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True)
    here = str(Path(__file__).parent.resolve())
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    os.chdir(folder)
    encoder()
    data()
    policies()
