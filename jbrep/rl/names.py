"""The names of algorithms and presets, known without importing what they are of."""

from jbrep.rl.cohort import ALGORITHMS

CLASSES = {  # by the names of algorithms
    "ddpg": "stable_baselines3.DDPG",
    "td3": "stable_baselines3.TD3",
    "sac": "stable_baselines3.SAC",
    "ppo": "stable_baselines3.PPO",
    "a2c": "stable_baselines3.A2C",
    "trpo": "sb3_contrib.TRPO",
    "tqc": "sb3_contrib.TQC",
    "crossq": "sb3_contrib.CrossQ",
}
DEVICES = CPU, CUDA = "cpu", "cuda"
COHORT, SB3 = "cohort", "sb3"
TRAINERS = {COHORT: tuple(ALGORITHMS), SB3: tuple(CLASSES)}  # and the algorithms that each has
FLOAT32, BFLOAT16 = "float32", "bfloat16"
PRECISIONS = {FLOAT32: (COHORT, SB3), BFLOAT16: (COHORT,)}  # and the trainers that have each
PAPER, MODERN = "paper", "modern"  # presets; the paper's unless another is named


def base_name(algorithm: str, preset: str) -> str:
    """An algorithm with its preset, unless that is the paper's: ddpg, sac-modern."""
    return algorithm if preset == PAPER else f"{algorithm}-{preset}"


def usual_trainer(algorithm: str) -> str:
    """What trains an algorithm unless another trainer is asked for."""
    return next((name for name, its in TRAINERS.items() if algorithm in its), SB3)
