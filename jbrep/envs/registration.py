"""The Jitterbug's ids in Gymnasium's registry."""

from jbrep.jitterbug.tasks import EPISODE_STEPS, TASKS

SOLVED = 900  # the return at which the paper calls a task solved


def environment_id(task: str) -> str:
    """Gymnasium's id of a task: `face_direction` is `Jitterbug/FaceDirection-v0`."""
    return f"Jitterbug/{task.title().replace('_', '')}-v0"


def register() -> None:
    """Register the five tasks; importing jbrep sees to it as soon as there is a Gymnasium."""
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            environment_id(task),
            entry_point="jbrep.envs.gym:JitterbugEnv",
            vector_entry_point="jbrep.envs.gym:JitterbugVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            reward_threshold=SOLVED,
            kwargs={"task": task},
        )
