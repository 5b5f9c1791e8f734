"""Forks: batches whose worlds all continue from the state of one world."""

from collections.abc import Sequence

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.engine import arguments
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import hooks


def fork(
    env: environment.Environment | batch_environment.BatchEnvironment,
    num_envs: int,
    *,
    world: int | None = None,
    num_threads: int = 0,
    sinks: Sequence[events.BatchEventSink] = (),
) -> batch_environment.BatchEnvironment:
  """Creates a batch whose worlds all continue from the state of one world.

  All worlds have the random streams of the original. Worlds that get the same
  actions therefore stay equal, bit for bit, and their later episodes are those
  of the original. The original does not change, and either environment can be
  closed first. They share their entities, so do not use them in two threads.

  Args:
    env: Environment of the original world, or a batch that contains it. The
      task is one of this package.
    num_envs: Number of worlds.
    world: Index of the original in the batch; `None` for a single world.
    num_threads: Number of threads that step them; 0 for all processors.
    sinks: Event sinks of the fork, of the same kinds as those of the original;
      they continue from its state. `BatchEnvironment.add_sink` would begin new
      episodes instead.

  Returns:
    The fork. The caller has to close it.

  Raises:
    SpecError: If there is no such world, if it cannot be saved, or if another
      argument is invalid.
    StateLayoutError: If the sinks differ, or if the compiled model was changed.
  """
  num_envs = arguments.num_envs(num_envs)
  num_threads = arguments.num_threads(num_threads)
  if not isinstance(sinks, Sequence) or not all(
      isinstance(sink, events.BatchEventSink) for sink in sinks
  ):
    raise errors.SpecError(
        f'sinks: {messages.quote(sinks)}; must be a list of BatchEventSinks'
    )
  if isinstance(env, batch_environment.BatchEnvironment):
    if world is None:
      raise errors.SpecError(
          f'world: None; must be an integer from 0 to {env.num_envs - 1}'
      )
    # Called on the class, because to mypy `env` may also be an `Environment`,
    # which is `Any`.
    snapshot = batch_environment.BatchEnvironment.save(env, [world])
    single = env.original
  elif isinstance(env, environment.Environment):
    if world is not None:
      raise errors.SpecError(
          f'world: {messages.quote(world)}; must be None, because env is not'
          ' a batch'
      )
    snapshot, single = env.save(), env
  else:
    raise errors.SpecError(
        f'env: {messages.quote(env)}; must be an environment of this package'
    )
  hooks.refuse_in_batch(single.task, single.has_extra_hooks)
  # The model is compiled again, because closing an environment frees its model.
  # This takes less time than one episode.
  copy = environment.Environment(
      single.task,
      single.mechanism,
      seed=single.seed,
      max_steps=single.max_steps,
      senses=single.senses,
  )
  try:
    batch = batch_environment.BatchEnvironment(copy, num_envs, num_threads)
    for sink in sinks:
      batch.add_sink(sink)
    batch.restore(snapshot, range(num_envs))
  except BaseException:
    copy.close()
    raise
  return batch
