"""Forks: batches whose worlds continue from the state of one world."""

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
  """Makes a batch whose worlds all go on from where one world is.

  They have the same random streams, which are those of the original: worlds
  that get the same actions stay the same, bit for bit, and their later episodes
  are those that the original would have. The original stays as it is; either
  can be closed before the other. Both share their entities, so they are not for
  two threads.

  Args:
    env: The original, or a batch that it is in. It has a world of this package.
    num_envs: How many worlds.
    world: The index of the original in the batch; `None` for one alone.
    num_threads: How many threads step them; 0 for all processors.
    sinks: What hears of the worlds from here on, of the same kinds as listen to
      the original. With `BatchEnvironment.add_sink` worlds would begin anew.

  Raises:
    SpecError: If there is no such world, if it cannot be saved, or if a number
      makes no sense.
    StateLayoutError: If the sinks differ, or if the compiled model was changed.
  """
  num_envs = arguments.num_envs(num_envs)
  num_threads = arguments.num_threads(num_threads)
  if not isinstance(sinks, Sequence) or not all(
      isinstance(sink, events.BatchEventSink) for sink in sinks
  ):
    raise errors.SpecError(
        f'sinks: {messages.quote(sinks)}; allowed is a list of BatchEventSinks'
    )
  if isinstance(env, batch_environment.BatchEnvironment):
    if world is None:
      raise errors.SpecError(
          f'world: None; allowed are integers from 0 to {env.num_envs - 1}'
      )
    # To mypy, `Environment` and all that is derived from dm_control is `Any`.
    snapshot = batch_environment.BatchEnvironment.save(env, [world])
    single = env.original
  elif isinstance(env, environment.Environment):
    if world is not None:
      raise errors.SpecError(
          f'world: {messages.quote(world)}; allowed is None, for the world is'
          ' alone'
      )
    snapshot, single = env.save(), env
  else:
    raise errors.SpecError(
        f'env: {messages.quote(env)}; allowed are environments of this package'
    )
  hooks.refuse_in_batch(single.task, single.has_extra_hooks)
  # Compiled anew, which takes less time than one episode: what is closed frees
  # its compiled world.
  copy = environment.Environment(
      single.task,
      single.mechanism,
      seed=single.seed,
      max_steps=single.max_steps,
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
