"""The names of algorithms and presets, known without importing what they are of."""

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
PAPER, MODERN = "paper", "modern"  # presets; the paper's unless another is named


def base_name(algorithm: str, preset: str) -> str:
    """An algorithm with its preset, unless that is the paper's: ddpg, sac-modern."""
    return algorithm if preset == PAPER else f"{algorithm}-{preset}"
