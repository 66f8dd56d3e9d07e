"""The Jitterbug's ids in Gymnasium's registry."""

from jbrep.jitterbug.tasks import EPISODE_STEPS, SOLVED_REWARD, TASKS, environment_id


def register() -> None:
    """Register the five tasks; with jbrep imported, Gymnasium's own import calls this."""
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            environment_id(task),
            entry_point="jbrep.jitterbug.gym:JitterbugEnv",
            vector_entry_point="jbrep.jitterbug.gym:JitterbugVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            reward_threshold=SOLVED_REWARD * EPISODE_STEPS,
            kwargs={"task": task},
        )
