from . import (
    actor_critic as actor_critic,
    checkpoint as checkpoint,
    chunks as chunks,
    demonstrations as demonstrations,
    learner as learner,
    pac as pac,
    schedules as schedules,
    settings as settings,
)
