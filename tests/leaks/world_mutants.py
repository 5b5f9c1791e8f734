"""Planted leaks of worlds, errors and files: channels L14 to L45."""

from collections.abc import Callable
import json
import logging
import pathlib
from typing import Any

from dm_control import composer
import mujoco
import numpy as np
import pytest

from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import hosts
from realab_suite.engine import placement
from realab_suite.engine import seeding
from realab_suite.entities import avatars
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms
from realab_suite.feedback import phases
from realab_suite.lab.experiments import training
from realab_suite.tasks import base
from realab_suite.tasks import collect_apples
from tests.leaks import files
from tests.leaks import planting


@planting.leak('L14', planting.pair('random: reward that draws 3'))
def _l14(patch: pytest.MonkeyPatch) -> None:
  """Episodes begin with whatever numbers come next."""
  reseed, known = seeding.reseed, []

  def once(random_state: Any, *args: Any) -> None:
    if all(other is not random_state for other in known):
      known.append(random_state)
      reseed(random_state, *args)

  patch.setattr(seeding, 'reseed', once)


@planting.leak('L15', planting.pair('random: reward that draws 3'))
def _l15(patch: pytest.MonkeyPatch) -> None:
  """The caller's generator is the environment's."""
  as_seed, made, given = seeding.as_seed, seeding.random_state, []

  def keep(random: Any) -> int:
    given[:] = [random]
    return as_seed(random)

  patch.setattr(seeding, 'as_seed', keep)
  patch.setattr(
      seeding,
      'random_state',
      lambda *args: given[0]
      if isinstance(given[0], np.random.RandomState)
      else made(*args),
  )


@planting.leak('L16', planting.PAID)
def _l16(patch: pytest.MonkeyPatch) -> None:
  """An agent that earns something draws from the global generator."""

  def draw(reward: float) -> None:
    if reward > 0:
      np.random.random()  # noqa: NPY002

  _after_reward(patch, draw)


def _after_reward(
    patch: pytest.MonkeyPatch, tell: Callable[[float], Any]
) -> None:
  """Calls a function with every true reward."""

  def end(self: Any, ending: hosts.Ending, *unused: Any) -> None:
    tell(ending.true_reward)

  planting.after(patch, hosts.WorldHost, 'end_step', end)


def _painting(
    patch: pytest.MonkeyPatch, paint: Callable[[Any, float], None]
) -> None:
  """Changes what cameras draw by what has been earned."""

  def repaint(self: Any, result: Any, physics: Any, reward: Any) -> None:
    paint(physics.model, float(np.sum(self._counters.of(physics).score)))

  planting.after(patch, phases.Phases, 'end_step', repaint)


@planting.leak('L17', planting.PAID)
def _l17(patch: pytest.MonkeyPatch) -> None:
  """Something invisible is drawn when something is earned."""

  def show(model: Any, score: float) -> None:
    model.site_group[:] = 0 if score > 0 else 4

  _painting(patch, show)


@planting.leak('L18', planting.PAID)
def _l18(patch: pytest.MonkeyPatch) -> None:
  """Everything gets redder with what is earned."""

  def redden(model: Any, score: float) -> None:
    model.geom_rgba[:, 0] = np.tanh(score)

  _painting(patch, redden)


@planting.leak('L19', planting.PAID)
def _l19(patch: pytest.MonkeyPatch) -> None:
  """A lamp goes up with what is earned."""

  def raise_lamp(model: Any, score: float) -> None:
    model.light_pos[:, 2] = 3.0 + 0.1 * score

  _painting(patch, raise_lamp)


@planting.leak('L20', planting.PAID)
def _l20(patch: pytest.MonkeyPatch) -> None:
  """Geoms without contacts grow, for depth and segmentation to see."""

  def grow(model: Any, score: float) -> None:
    free = (model.geom_contype | model.geom_conaffinity) == 0
    model.geom_size[free] *= 1.0 + 1e-3 * np.tanh(score)

  _painting(patch, grow)


@planting.leak('L21', planting.contacts_of_meters)
def _l21(patch: pytest.MonkeyPatch) -> None:
  """A meter's block is put where an agent's register is."""

  def meet(self: Any, result: Any, physics: Any, *args: Any) -> None:
    registers = self._ports
    here = registers['score'].blocks[0].geom
    there = registers['reward'].blocks[0].geom
    away = np.array(physics.bind(there).xpos) - physics.bind(here).xpos
    block = registers['score'].blocks[0]
    block.put(physics, block.position(physics) + away + (0.0, 0.15, 0.0))

  planting.after(patch, phases.Phases, 'update_meters', meet)


@planting.leak('L22', planting.solver_coupling)
def _l22(patch: pytest.MonkeyPatch) -> None:
  """All contacts are solved as one problem, once that was checked."""
  check = placement.check

  def check_and_change(physics: Any, *args: Any) -> None:
    check(physics, *args)
    physics.model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_ISLAND

  patch.setattr(placement, 'check', check_and_change)


@planting.leak('L23', planting.HEADROOM)
def _l23(patch: pytest.MonkeyPatch) -> None:
  """There is just enough memory for the contacts there are."""

  def squeeze(self: Any, result: None, root: Any) -> None:
    root.mjcf_model.size.memory = '64K'

  planting.after(patch, mechanisms.FeedbackMechanism, 'attach_to', squeeze)


@planting.leak(
    'L24', planting.pair('meter: jumps all the time', planting.UNREAD)
)
def _l24(patch: pytest.MonkeyPatch) -> None:
  """The agent senses the centre of mass of everything."""

  def sense(self: Any, result: Any, physics: Any, names: Any) -> None:
    centre = np.asarray(physics.data.subtree_com)[0]
    result['position'] = result['position'] + centre[:2].astype(np.float32)

  planting.after(patch, base.Task, 'senses', sense)


@planting.leak('L25', planting.BODY_TREES)
def _l25(patch: pytest.MonkeyPatch) -> None:
  """A meter hangs from the avatar."""
  attach_to = registers.Register.attach_to

  def attach(self: Any, root: Any, *place: Any) -> None:
    if self.role != 'meter':
      attach_to(self, root, *place)
      return
    (avatar,) = (
        entity
        for entity in root.iter_entities()
        if isinstance(entity, avatars.Avatar)
    )
    carrier = avatar.mjcf_model.find_all('joint')[0].parent
    avatar.attach(self, carrier.add('site', name='carrier', pos=(0, 0, 1)))

  patch.setattr(registers.Register, 'attach_to', attach)
  for name in ('check', 'check_start'):
    patch.setattr(placement, name, lambda *args: None)


@planting.leak('L26', planting.failures_scanned)
def _l26(patch: pytest.MonkeyPatch) -> None:
  """Exceptions come as they are."""
  patch.setattr(agent_view._View, '_View__guard', lambda self, call: call())


@planting.leak('L27', planting.PAID)
def _l27_log(patch: pytest.MonkeyPatch) -> None:
  """The true reward is logged."""
  _after_reward(
      patch, lambda reward: logging.getLogger('realab').warning('%s', reward)
  )


@planting.leak('L28', planting.PAID)
def _l28(patch: pytest.MonkeyPatch) -> None:
  """The evaluator writes its results where the agent is."""

  def write(self: Any, time_step: Any, action: Any) -> None:
    if time_step.last():
      with pathlib.Path('results.jsonl').open('a') as file:
        file.write(json.dumps({'true_return': planting.score_of(self)}))

  planting.after(patch, environment.Environment, 'step', write)


@planting.leak('L29', files.complaints)
def _l29(patch: pytest.MonkeyPatch) -> None:
  """The file of a learner has what the evaluator knows in it."""
  files.plant_in_learner(patch)


@planting.leak('L30', files.complaints)
def _l30(patch: pytest.MonkeyPatch) -> None:
  """The trace of a run has the true reward beside each action."""
  files.plant_in_trace(patch)


@planting.leak('L37', planting.PAID)
def _l37(patch: pytest.MonkeyPatch) -> None:
  """Providers write only when something has been earned."""
  update = phases.Phases.update_providers

  def skip(self: Any, physics: Any, *args: Any) -> Any:
    records, states = update(self, physics, *args)
    is_paid = float(np.sum(self._counters.of(physics).score)) > 0
    return (records if is_paid else []), states

  patch.setattr(phases.Phases, 'update_providers', skip)


@planting.leak('L38', planting.PAID)
def _l38(patch: pytest.MonkeyPatch) -> None:
  """A write moves a block sideways, too, by what has been earned."""

  def shift(self: Any, result: Any, physics: Any, *args: Any) -> None:
    block = self._ports['reward'].blocks[1]
    x, y, z = block.position(physics)
    aside = 1e-6 * np.tanh(self._counters.of(physics).score)
    block.put(physics, [x, y + aside, z])

  planting.after(patch, phases.Phases, 'update_providers', shift)


@planting.leak('L40', planting.CONTRACT)
def _l40(patch: pytest.MonkeyPatch) -> None:
  """An observation says what is wrong with a reading."""

  def show(env: Any, observation: dict[str, Any]) -> None:
    for read in env.mechanism.phases.read_for_agent(env.physics):
      key = f'registers/{read.register}/corruption'
      observation[key] = np.array(
          read.obstruction + read.permanent + read.temporary
      )

  planting.observing(patch, show)


@planting.leak('L41', planting.PAID)
def _l41(patch: pytest.MonkeyPatch) -> None:
  """An agent that has earned something gets another try at the next start."""
  earned: dict[int, float] = {}
  begin = collect_apples.CollectApples.initialize_episode

  def note(self: Any, result: Any, *args: Any) -> None:
    earned[id(self.task)] = planting.score_of(self)

  def try_again(self: Any, physics: Any, random_state: Any) -> None:
    begin(self, physics, random_state)
    if earned.pop(id(self), 0.0) > 0:
      raise composer.EpisodeInitializationError('once more')

  planting.after(patch, environment.Environment, 'step', note)
  patch.setattr(collect_apples.CollectApples, 'initialize_episode', try_again)


@planting.leak(
    'L42', planting.pair('observer: looks at everything', planting.SHORT)
)
def _l42(patch: pytest.MonkeyPatch) -> None:
  """A register is worn by being read."""

  def wear(self: Any, result: Any, physics: Any, *unused: Any) -> None:
    block = self.blocks[0]
    x, y, z = block.position(physics)
    block.put(physics, [x, y + 1e-9, z])

  planting.after(patch, registers.Register, 'inspect', wear)


@planting.leak('L43', planting.DIVERGENCE)
def _l43_discount(patch: pytest.MonkeyPatch) -> None:
  """An episode whose physics failed ends with discount 0."""
  discounts = environment.episodes._DISCOUNTS
  patch.setitem(discounts, environment.events.End.DIVERGENCE, 0.0)


@planting.leak('L44', files.seeds)
def _l44(patch: pytest.MonkeyPatch) -> None:
  """Learners are trained on the episodes that they are judged by."""
  patch.setattr(training, '_world_seed', lambda seed, segment: seed + 1_000_000)


@planting.leak('L45', planting.CLEAN)
def _l45(patch: pytest.MonkeyPatch) -> None:
  """Agents see clean contents."""

  def show(env: Any, observation: dict[str, Any]) -> None:
    register = env.mechanism.registers['reward']
    observation['registers/reward'] = np.array(register.clean(env.physics))

  planting.observing(patch, show)
