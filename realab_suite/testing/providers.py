"""Contract of feedback providers: pure functions that serve whole batches."""

from collections.abc import Mapping, Sequence
import contextlib
import copy
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite import trees
from realab_suite.feedback import provider_results
from realab_suite.feedback.providers import base
from realab_suite.testing import contracts

_NUM_WORLDS = 3
_NUM_STEPS = 8
# World 1 begins another episode in this step.
_SECOND_START = 3
_RANGE = (-2.0, 16.0)
# Readings of these steps are 0 in every register whose range has it.
_ZEROS = 1, 2, 7
# Readings of these steps are those of the step before.
_REPEATED = 4, 6

# Arguments of `step`, without the state.
_Inputs = tuple[Any, Any, Any, Any]


def check_provider(
    provider: base.Provider,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    *,
    domain_name: str = 'unlock_door',
    task_name: str = 'standard',
) -> None:
  """Checks that a provider keeps the contract of providers.

  - Equal inputs give equal outputs. Inputs and earlier outputs stay unchanged.
  - It writes finite numbers, and only to the registers that it declares, also
    where a reading is 0 or stands still.
  - Each world of a batch gets what it would get alone.
  - An episode does not depend on the one before.

  Where it names the policy `solver`, it gets the solver of the world.

  Args:
    provider: The provider.
    ranges: Lowest and highest reading of the registers that it reads, by name;
      -2 to 16 for others.
    domain_name: Domain of the world whose senses it gets.
    task_name: Task of that world.

  Raises:
    ContractError: If it does not, with the first part that it breaks.
  """
  contracts.require(
      isinstance(provider, base.Provider),
      f'{provider!r:.80}: must be a provider, an instance of its class',
  )
  with contextlib.closing(
      suite.load(domain_name, task_name, design=None)
  ) as env:
    provider = provider.in_world(env.task.SOLVER)
  worlds = [
      _inputs(provider, ranges or {}, world, (domain_name, task_name))
      for world in range(_NUM_WORLDS)
  ]
  batch = [_together(of_worlds) for of_worlds in zip(*worlds, strict=True)]
  _check_purity(provider, worlds[0], ())
  _check_purity(provider, batch, (_NUM_WORLDS,))
  _check_batch(provider, batch, worlds)
  _check_episodes(provider, worlds)


def _inputs(
    provider: base.Provider,
    ranges: Mapping[str, tuple[float, float]],
    world: int,
    names: tuple[str, str],
) -> list[_Inputs]:
  """Returns the inputs of the steps of one world, without the state."""
  env = suite.load(
      *names,
      {'random': 1},
      {
          'world': world,
          'max_steps': _NUM_STEPS,
          # The agent needs at least one sense.
          'senses': sorted({*provider.required_senses, 'time_left'}),
      },
      design=None,
  )
  generator = np.random.default_rng(world)
  spec = env.action_spec()
  time_step = env.reset()
  steps: list[Any] = []
  for step in range(_NUM_STEPS):
    readings = {
        name: np.array(_number(generator, ranges.get(name, _RANGE), step))
        for name in provider.reads
    }
    if step in _REPEATED:
      readings = {name: np.array(one) for name, one in steps[-1][1].items()}
    start = step == 0 or (world == 1 and step == _SECOND_START)
    key = generator.integers(2**63, size=2, dtype=np.uint64)
    observation = {
        f'senses/{name}': time_step.observation[f'senses/{name}']
        for name in provider.required_senses
    }
    for name in provider.privileged_senses:
      sensed = env.task.privileged_senses[name](env.physics)
      observation[f'privileged/{name}'] = np.array(sensed)
    for name in (*provider.reads, *provider.writes):
      number = _number(generator, ranges.get(name, _RANGE), step)
      observation[f'registers/{name}'] = np.array(number)
    steps.append((observation, readings, np.array(start), key))
    time_step = env.step(generator.uniform(spec.minimum, spec.maximum))
  env.close()
  return steps


def _number(
    generator: np.random.Generator, low_high: tuple[float, float], step: int
) -> float:
  """Returns a random number, or what is closest to 0 in some steps."""
  number = generator.uniform(*low_high)
  return float(np.clip(0.0, *low_high)) if step in _ZEROS else number


def _together(parts: Sequence[Any]) -> Any:
  """Returns the inputs of a batch from those of its worlds."""
  if isinstance(parts[0], tuple):
    return tuple(map(_together, zip(*parts, strict=True)))
  if isinstance(parts[0], dict):
    return {
        name: _together([part[name] for part in parts]) for name in parts[0]
    }
  return np.stack(parts)


def _step(
    provider: base.Provider,
    inputs: _Inputs,
    state: Any,
    batch_shape: tuple[int, ...],
) -> Any:
  """Returns the result of `step`, which the engine has to accept.

  Args:
    provider: The provider.
    inputs: Arguments without the state.
    state: State before the step.
    batch_shape: `()` for one world, `(worlds,)` for a batch.

  Raises:
    ContractError: If `step` fails, or the engine refuses its result.
  """
  where = f'provider {provider.kind!r}'
  try:
    returned = provider.step(*inputs, state)
    _, following = provider_results.checked(provider, returned, batch_shape)
    if batch_shape:
      first = provider.initial_state(batch_shape)
      provider_results.check_state('initial_state', first, batch_shape)
      none = np.zeros(batch_shape, bool)
      provider_results.merged('state', following, first, none)
  except errors.FeedbackProviderError as error:
    raise contracts.ContractError(f'{where}: {error}') from error
  except Exception as error:  # Providers may raise any class.
    raise contracts.ContractError(
        f'{where}: {provider.why_it_failed(error)}'
    ) from error
  return returned


def _check_purity(
    provider: base.Provider,
    steps: list[_Inputs],
    batch_shape: tuple[int, ...],
) -> None:
  """Checks that a provider is a function that changes nothing."""
  twin = provider.model_copy(deep=True)
  where = f'provider {provider.kind!r}'
  state = provider.initial_state(batch_shape)
  contracts.require(
      trees.are_equal(state, twin.initial_state(batch_shape)),
      f'{where}: initial_state differs between two equal providers',
  )
  for inputs in steps:
    before = copy.deepcopy((*inputs, state))
    first = _step(provider, inputs, state, batch_shape)
    kept = copy.deepcopy(first)
    contracts.require(
        trees.are_equal((*inputs, state), before),
        f'{where}: step changed its arguments; return new arrays',
    )
    again = provider.step(*inputs, state)
    of_twin = twin.step(*before)
    contracts.require(
        trees.are_equal(again, kept) and trees.are_equal(of_twin, kept),
        f'{where}: equal arguments gave other results; keep what it remembers'
        ' in the state, and draw from the key',
    )
    contracts.require(
        trees.are_equal(first, kept),
        f'{where}: a later step changed an earlier result',
    )
    state = first[1]


def _parts(write: Any) -> tuple[Any, Any]:
  """Returns the value of a write, and whether the provider speaks."""
  return write if isinstance(write, tuple) else (write, np.array(True))


def _check_batch(
    provider: base.Provider,
    batch: list[_Inputs],
    worlds: list[list[_Inputs]],
) -> None:
  """Checks that each world of a batch gets what it would get alone."""
  where = f'provider {provider.kind!r}'
  together = provider.initial_state((_NUM_WORLDS,))
  alone = [provider.initial_state(()) for _ in worlds]
  for number, inputs in enumerate(batch):
    writes, together = _step(provider, inputs, together, (_NUM_WORLDS,))
    for world, steps in enumerate(worlds):
      expected, alone[world] = _step(provider, steps[number], alone[world], ())
      for name in {*expected} | {*writes}:
        value, speaks = _parts(expected.get(name, (np.zeros(()), False)))
        values, speak = _parts(writes.get(name, (np.zeros(3), False)))
        contracts.require(
            np.shape(value) == () and np.shape(values) == (_NUM_WORLDS,),
            f'{where}: wrote {name!r} with the shapes {np.shape(value)} for one'
            f' world and {np.shape(values)} for {_NUM_WORLDS}',
        )
        spoken = bool(np.broadcast_to(speak, _NUM_WORLDS)[world])
        contracts.require(
            not spoken or np.isfinite(np.asarray(value, float)),
            f'{where}: wrote {value} to {name!r}; values have to be finite',
        )
        contracts.require(
            spoken == bool(speaks) and (not spoken or values[world] == value),
            f'{where}: wrote {values[world]} to {name!r} in a batch, and'
            f' {value} in that world alone',
        )


def _check_episodes(
    provider: base.Provider, worlds: list[list[_Inputs]]
) -> None:
  """Checks that an episode does not depend on the one before."""
  worn = provider.initial_state(())
  for inputs in worlds[1]:
    _, worn = _step(provider, inputs, worn, ())
  fresh = provider.initial_state(())
  for inputs in worlds[0]:
    from_worn, worn = _step(provider, inputs, worn, ())
    from_fresh, fresh = _step(provider, inputs, fresh, ())
    contracts.require(
        trees.are_equal(from_worn, from_fresh),
        f'provider {provider.kind!r}: an episode depends on the one before;'
        ' begin anew where episode_start is True',
    )
