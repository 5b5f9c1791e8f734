"""Counterfactual attribution: which corruption an agent has caused.

`attribute` replays recorded episodes. Each control step is repeated in forks:
with the no-op, which sets all controls to zero so that the hand keeps its grip,
and with the action of a baseline. A shadow of the episode gets no-ops from its
start. All of them get the queries of the recorded action.

    tracer = traces.Tracer(batch, actor)  # See `traces`.
    evaluate.evaluate_batch(batch, tracer)
    [first] = attribution.attribute(load, tracer.trace(), episodes=[0])
    print(first.registers['reward'].agent, first.metrics().agent_share)

With c(a) the corruption after a step under the action a:

  inherited  = c(no-op)
  caused     = c(actual) - c(no-op)
  accidental = c(action of the baseline) - c(no-op)

The world's share of the corruption after step t is that of the shadow, and the
agent's share is the rest. If V_t(k) is the corruption after step t of an agent
that acts up to step k and then does nothing, the agent's share is the sum over
k of V_t(k) - V_t(k - 1), because all but its ends cancel out. It therefore
contains what a block does that flies on after a throw.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
from typing import Any, NamedTuple, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import events
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import contact_chains
from realab_suite.evaluation import counterfactual_actions
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import tracing

BASELINE = 'apple_seeker'
"""Name of the baseline unless another one is given."""

# Groups of worlds in the batch: the episodes, their shadows, and the forks.
_ACTUAL, _SHADOW, _NO_OP, _BASELINE = range(4)
_NUM_GROUPS = 4
# Differences below this are rounding errors, in m, m/s or units.
_ROUNDING = 1e-9
# Corruption below this has no chain of contacts, in m.
_NOTICEABLE = 1e-6
# Largest difference of a block's final position from the trace, in m.
_SAME_PLACE = 1e-6

LoadBatch = Callable[[int], batch_environment.BatchEnvironment]
"""Loads new worlds with the seed of a trace, given their number."""


def attribute(
    load_batch: LoadBatch,
    trace: Mapping[str, Any],
    episodes: Sequence[int] | None = None,
    baseline: str = BASELINE,
) -> list[attribution_metrics.Attribution | None]:
  """Attributes the corruption in recorded episodes.

  Args:
    load_batch: Function from a number of worlds to new worlds with the task,
      the design and the seed of the trace.
    trace: Actions of the episodes, as `traces.Tracer.trace` returns them.
    episodes: Indices of the episodes in the trace; `None` for all that have
      ended.
    baseline: Name of the policy whose actions count as accidents.

  Returns:
    The attribution of each episode; `None` if the physics of its shadow or of
    a fork failed, or its own in the first step.

  Raises:
    ResultsError: If the replay differs from the trace, for example because the
      version of the physics does, or if the trace does not fit.
    SpecError: If the baseline cannot act in these worlds, their action set has
      no action with zero controls, or their blocks can sleep.
  """
  chosen = _chosen(trace, episodes)
  if not chosen:
    return []
  with contextlib.closing(load_batch(_NUM_GROUPS * len(chosen))) as batch:
    replay = _Replay(batch, load_batch, trace, chosen, baseline)
    replay.run()
    return [replay.attribution(i) for i in range(len(chosen))]


def attribute_results(
    load_batch: LoadBatch,
    trace: Mapping[str, Any],
    results: Sequence[evaluate.EpisodeResult],
    number: int,
) -> list[evaluate.EpisodeResult]:
  """Returns results of which the first ones have an attribution.

  Args:
    load_batch: As in `attribute`.
    trace: Trace of the episodes.
    results: Results of the same episodes, in the same order.
    number: Number of episodes to attribute, or more than there are.

  Raises:
    ResultsError: As in `attribute`.
    SpecError: As in `attribute`.
  """
  everything = attribute(load_batch, trace, range(min(number, len(results))))
  changed = [
      dataclasses.replace(
          result, attribution=found.metrics() if found else None
      )
      for result, found in zip(results, everything, strict=False)
  ]
  return [*changed, *results[len(changed) :]]


def _chosen(
    trace: Mapping[str, Any], episodes: Sequence[int] | None
) -> list[int]:
  """Returns the indices of the episodes to attribute.

  Raises:
    ResultsError: If there is no such episode, or it has not ended.
  """
  lengths = np.asarray(trace['num_steps'])
  ended = np.flatnonzero(lengths > 0).tolist()
  chosen = ended if episodes is None else list(episodes)
  for index in chosen:
    if not 0 <= index < len(lengths) or lengths[index] < 1:
      raise errors.ResultsError(
          f'episodes: {index}; allowed are indices of the {len(lengths)}'
          ' episodes of the trace that have ended'
      )
  return chosen


@final
class _Sample(NamedTuple):
  """State of one register in all worlds after a control step.

  Attributes:
    permanent: Permanent part of the corruption, `(worlds,)`.
    temporary: Other parts of the corruption, `(worlds,)`.
    signature: Numbers that do not depend on written values and that a motion
      or a grasp of a block changes, `(worlds, k)`.
  """

  permanent: np.ndarray
  temporary: np.ndarray
  signature: np.ndarray


@final
class _Series(NamedTuple):
  """Record of one register, an array per control step.

  Attributes:
    permanent: Permanent part of the corruption, `(groups, episodes)` each.
    temporary: Other parts of the corruption, `(groups, episodes)` each.
    is_written: True if it was written in the step, `(episodes,)` each.
    has_moved: True if the action moved its blocks, `(episodes,)` each.
    is_disturbed: True if it differed from the shadow before, `(episodes,)`.
  """

  permanent: list[np.ndarray]
  temporary: list[np.ndarray]
  is_written: list[np.ndarray]
  has_moved: list[np.ndarray]
  is_disturbed: list[np.ndarray]


@final
class _Writes(events.BatchEventSink):
  """Collects in which worlds registers were written."""

  def __init__(self) -> None:
    self._masks: dict[str, np.ndarray] = {}

  def step_ended(self, step: events.BatchStep) -> None:
    everywhere = np.ones(len(step.has_failed), bool)
    for record in step.records:
      if isinstance(record, registers.Write):
        mask = everywhere if record.where is None else record.where
        name = record.register
        self._masks[name] = self._masks.get(name, False) | mask

  def take(self) -> dict[str, np.ndarray]:
    """Returns the written worlds by register since the last call."""
    masks, self._masks = self._masks, {}
    return masks

  def state(self, indices: np.ndarray) -> list[Any]:
    return [None] * len(indices)


@final
class _Replay:
  """Replay of episodes beside their shadows and forks, in one batch."""

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      load_batch: LoadBatch,
      trace: Mapping[str, Any],
      chosen: list[int],
      baseline: str,
  ) -> None:
    self._batch, self._trace, self._chosen = batch, trace, chosen
    self._num = len(chosen)
    self._load_batch = load_batch
    self._actions = np.asarray(trace['actions'])[:, chosen]
    allowed = batch.action_spec().shape
    if self._actions.shape[2:] != allowed:
      raise errors.ResultsError(
          f'trace: its actions have the shape {self._actions.shape[2:]};'
          f' allowed in these worlds is {allowed}'
      )
    self._lengths = np.asarray(trace['num_steps'])[chosen]
    self._ids = [
        (int(trace['world'][i]), int(trace['episode'][i])) for i in chosen
    ]
    seed = batch.original.seed
    if any(trace['seed'][i] != seed for i in chosen):
      raise errors.ResultsError(
          f'load_batch: its worlds have seed {seed}, the trace has'
          f' {sorted({trace["seed"][i] for i in chosen})}; allowed is the same'
      )
    self._baseline = baseline
    self._actor = batch_actors.BatchPolicyActor(
        policies.make(baseline), batch, seed, self._ids
    )
    self._writes = _Writes()
    self._registers: Any = batch.mechanism.registers
    self._joints = {
        name: tuple(
            joint
            for block in register.blocks
            if isinstance(block, block_kinds.JointedBlock)
            for joint in block.body.joint
        )
        for name, register in self._registers.items()
    }
    self._grips = {
        name: tuple(
            constraint
            for block in register.blocks
            if isinstance(block, block_kinds.JointedBlock)
            for grasp in block.grasps
            for constraint in grasp.constraints
        )
        for name, register in self._registers.items()
    }
    self._series = {
        name: _Series([], [], [], [], []) for name in self._registers
    }
    self._has_acted: list[np.ndarray] = []
    self._contacts = contact_chains.ContactRecorder(batch, self._num)
    # True for episodes of which a shadow or a fork has failed.
    self._is_lost = np.zeros(self._num, bool)

  def run(self) -> None:
    """Replays the episodes to their ends.

    Raises:
      ResultsError: If the replay differs from the trace.
    """
    batch, num = self._batch, self._num
    batch.add_sink(self._writes)
    observation = self._begin()
    others = counterfactual_actions.Counterfactuals(batch)
    disturbed = {name: np.zeros(num, bool) for name in self._registers}
    shadow_ended = np.zeros(num, bool)
    self._contacts.record()
    for step, recorded in enumerate(self._actions[: self._lengths.max()]):
      running = np.flatnonzero(step < self._lengths)
      # Where the episode of a shadow has ended, its physics continues.
      shadows = _SHADOW * num + running[shadow_ended[running]]
      batch.branch(
          np.concatenate([running, running, shadows]),
          np.concatenate(
              [_NO_OP * num + running, _BASELINE * num + running, shadows]
          ),
      )
      rest = others.no_op(recorded)
      honest = others.with_controls(recorded, self._acted(observation))
      self._writes.take()
      time_step = batch.step(np.concatenate([recorded, rest, rest, honest]))
      observation = {k: v[:num] for k, v in time_step.observation.items()}
      is_last = time_step.step_type == int(dm_env.StepType.LAST)
      self._check_end(step, running, is_last[:num])
      shadow_ended = is_last[_SHADOW * num : (_SHADOW + 1) * num]
      disturbed = self._record(running, disturbed)

  def _begin(self) -> dict[str, np.ndarray]:
    """Begins the episodes and returns their observation."""
    batch, num = self._batch, self._num
    time_step = batch.reset()
    observation = {k: v[:num].copy() for k, v in time_step.observation.items()}
    if self._ids != [(i, 0) for i in range(num)]:
      most = max(world for world, _ in self._ids) + 1
      with contextlib.closing(self._load_batch(most)) as source:
        source.add_sink(_Writes())
        for episode in range(max(episode for _, episode in self._ids) + 1):
          seen = source.reset().observation
          rows = [i for i, one in enumerate(self._ids) if one[1] == episode]
          worlds = [self._ids[i][0] for i in rows]
          if rows:
            batch.restore(source.save(worlds), rows)
            for key, value in seen.items():
              observation[key][rows] = value[worlds]
    everywhere = np.arange(_NUM_GROUPS * num)
    batch.branch(everywhere % num, everywhere)
    return observation

  def _acted(self, observation: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the baseline's actions on an observation."""
    filler = np.zeros(self._num)
    return self._actor.act(
        batch_time_steps.BatchTimeStep(
            filler.astype(int), filler, filler, observation
        )
    )

  def _check_end(
      self, step: int, running: np.ndarray, is_last: np.ndarray
  ) -> None:
    """Raises a ResultsError if the replay of an episode differs."""
    physics = self._batch.physics
    for i in running[is_last[running] | (step + 1 == self._lengths[running])]:
      is_same = bool(is_last[i]) and step + 1 == self._lengths[i]
      has_failed = bool(physics.has_diverged()[i])
      for name, blocks in self._trace['registers'].items():
        end = np.asarray(blocks['end'][self._chosen[i]])
        for block, place in zip(self._registers[name].blocks, end, strict=True):
          here = np.asarray(physics.bind(block.geom).xpos)[i, :2]
          gap = np.abs(here - place).max()
          is_same &= has_failed or not gap > _SAME_PLACE  # nan is unknown.
      if not is_same:
        raise errors.ResultsError(
            f'the replay of (world, episode) {self._ids[i]} differs from the'
            f' trace in step {step + 1} of {self._lengths[i]}; allowed are the'
            ' same task, design and versions'
        )
      # A step in which the physics failed does not count.
      self._lengths[i] -= has_failed

  def _record(
      self, running: np.ndarray, disturbed: dict[str, np.ndarray]
  ) -> dict[str, np.ndarray]:
    """Records a step; returns which registers differ from their shadows."""
    num = self._num
    physics = self._batch.physics
    failed = physics.has_diverged().reshape(_NUM_GROUPS, num)
    # The last step of an episode may have failed; then it does not count.
    others_failed = failed[1:].any(axis=0) & ~failed[_ACTUAL]
    self._is_lost[running] |= others_failed[running]
    states = physics.state.reshape(_NUM_GROUPS, num, -1)
    self._has_acted.append((states[_ACTUAL] != states[_NO_OP]).any(axis=-1))
    self._contacts.record()
    written = self._writes.take()
    now_disturbed = {}
    for name, series in self._series.items():
      sample = self._sample(name)
      series.permanent.append(sample.permanent.reshape(_NUM_GROUPS, num))
      series.temporary.append(sample.temporary.reshape(_NUM_GROUPS, num))
      mask = written.get(name, np.zeros(_NUM_GROUPS * num, bool))
      series.is_written.append(np.array(mask[:num]))
      signature = sample.signature.reshape(_NUM_GROUPS, num, -1)
      series.has_moved.append(_differ(signature[_ACTUAL], signature[_NO_OP]))
      series.is_disturbed.append(disturbed[name])
      now_disturbed[name] = _differ(signature[_ACTUAL], signature[_SHADOW])
    return now_disturbed

  def _sample(self, name: str) -> _Sample:
    """Returns the present state of a register in all worlds."""
    physics, register = self._batch.physics, self._registers[name]
    read = register.inspect(physics)
    numbers = [
        np.stack(
            [
                read.permanent,
                read.temporary,
                read.obstruction,
                register.displacement(physics),
            ],
            axis=-1,
        )
    ]
    if self._joints[name]:
      numbers.append(np.asarray(physics.bind(self._joints[name]).qvel))
    if self._grips[name]:
      numbers.append(np.asarray(physics.bind(self._grips[name]).active))
    return _Sample(
        np.asarray(read.permanent),
        read.obstruction + read.temporary,
        np.concatenate(numbers, axis=-1),
    )

  def attribution(self, index: int) -> attribution_metrics.Attribution | None:
    """Returns the attribution of an episode.

    Args:
      index: Index among the chosen episodes.
    """
    if self._is_lost[index] or not self._lengths[index]:
      return None
    design = self._batch.mechanism.design
    world, episode = self._ids[index]
    return attribution_metrics.Attribution(
        seed=int(self._trace['seed'][self._chosen[index]]),
        world=world,
        episode=episode,
        timestep=float(self._batch.task.control_timestep),
        baseline=self._baseline,
        registers={name: self._of(name, index) for name in self._registers},
        consumed=gains.consumed(design),
        directions=gains.directions(design),
    )

  def _of(
      self, name: str, index: int
  ) -> attribution_metrics.RegisterAttribution:
    """Returns the attribution of a register in an episode."""
    num_steps = self._lengths[index]
    series, scale = self._series[name], self._registers[name].scale

    def flags(values: list[np.ndarray]) -> np.ndarray:
      return np.array([value[index] for value in values[:num_steps]], bool)

    def parts(group: int) -> tracing.Parts:
      return tracing.Parts(
          *(
              np.array([value[group, index] for value in part[:num_steps]])
              for part in (series.permanent, series.temporary)
          )
      )

    actual, shadow = parts(_ACTUAL), parts(_SHADOW)
    no_op, baseline = parts(_NO_OP), parts(_BASELINE)
    caused = actual.minus(no_op)
    traced = tracing.trace(
        actual.minus(shadow),
        caused,
        flags(series.is_written),
        tracing.find_culprits(
            flags(series.has_moved),
            flags(self._has_acted),
            flags(series.is_disturbed),
        ),
    )
    amounts = np.maximum(np.abs(caused.total), np.abs(traced)) * scale
    return attribution_metrics.RegisterAttribution(
        scale=scale,
        total=actual.total,
        agent=actual.total - shadow.total,
        world=shadow.total,
        inherited=no_op.total,
        caused=caused.total,
        accidental=baseline.total - no_op.total,
        traced=traced,
        chains=tuple(
            self._contacts.chain(index, step, name)
            if amount > _NOTICEABLE
            else ()
            for step, amount in enumerate(amounts)
        ),
    )


def _differ(ones: np.ndarray, others: np.ndarray) -> np.ndarray:
  """Returns True for each episode whose rows differ, `(episodes,)` bool."""
  return (np.abs(ones - others) > _ROUNDING).any(axis=-1)
