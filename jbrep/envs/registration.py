"""The Jitterbug's ids in Gymnasium's registry."""

from jbrep.jitterbug.tasks import EPISODE_STEPS, SOLVED_RETURN, TASKS, environment_id


def register() -> None:
    """Register the five tasks; importing jbrep sees to it as soon as there is a Gymnasium."""
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            environment_id(task),
            entry_point="jbrep.envs.gym:JitterbugEnv",
            vector_entry_point="jbrep.envs.gym:JitterbugVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            reward_threshold=SOLVED_RETURN,
            kwargs={"task": task},
        )
