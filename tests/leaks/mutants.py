"""Planted leaks, one or more per channel, and what finds each: campaign C09.

A mutant patches what is under test. `MUTANTS` has them all; another module adds
its own with the decorator `leak`. Channels that cannot exist within a process,
or that are declared, are in `NOT_HERE`, with the reason.
"""

from collections.abc import Callable, Iterator
import functools
import json
import logging
import pathlib
from typing import Any, NamedTuple
import warnings

from dm_control import composer
import dm_env
from dm_env import specs
import mujoco
import numpy as np
import pytest

from campaigns import solver_coupling_campaign
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import placement
from realab_suite.engine import seeding
from realab_suite.entities import avatars
from realab_suite.entities import registers
from realab_suite.experiments import training
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base
from realab_suite.tasks import collect_apples
from tests.leaks import contract
from tests.leaks import failures
from tests.leaks import files
from tests.leaks import pairs
from tests.leaks import secrets
from tests.leaks import walk

# Returns complaints, none if all is well.
Check = Callable[[], list[str]]

_SHORT = pairs.Case(steps=14, max_steps=6)
_BATCH = _SHORT._replace(num_envs=2)
_UNREAD = _SHORT._replace(variation='boxed', design='unread_meter')

NOT_HERE = {
    'L31': 'within one process nothing keeps code from looking: no promise',
    'L32': 'served environments',
    'L33': 'served environments',
    'L34': 'served environments',
    'L35': 'served environments',
    'L36': 'served environments; advisory',
    'L39': 'declared: a provider is trusted with what it reads',
}


class Mutant(NamedTuple):
  """A leak that somebody could build.

  Attributes:
    channel: `L1` to `L44`.
    what: What leaks, in words.
    plant: Builds it.
    check: What has to find it.
  """

  channel: str
  what: str
  plant: Callable[[pytest.MonkeyPatch], None]
  check: Check


MUTANTS: list[Mutant] = []

_Plant = Callable[[pytest.MonkeyPatch], None]


def leak(channel: str, check: Check) -> Callable[[_Plant], _Plant]:
  """Returns a decorator that registers a leak; what leaks is its docstring."""

  def decorate(plant: _Plant) -> _Plant:
    what = (plant.__doc__ or '').strip().splitlines()[0]
    MUTANTS.append(Mutant(channel, what, plant, check))
    return plant

  return decorate


def found_by(mutant: Mutant) -> list[str]:
  """Plants a leak and returns what is found of it."""
  with pytest.MonkeyPatch.context() as patch:
    mutant.plant(patch)
    return mutant.check()


# What looks for leaks.


def _pair(
    secret: str,
    case: pairs.Case = _SHORT,
    leave_out: tuple[str, ...] = (),
) -> Check:
  return _Checks.pair(secret, case, leave_out)


class _Checks:
  """Every check is one object, so that it is shown once to find nothing."""

  @staticmethod
  @functools.cache
  def pair(secret: str, case: pairs.Case, leave_out: tuple[str, ...]) -> Check:
    def check() -> list[str]:
      return pairs.differences(
          case, secrets.SECRETS[secret], leave_out=leave_out
      )

    check.__doc__ = f'pair: {secret}'
    return check

  @staticmethod
  @functools.cache
  def of(function: Callable[[pairs.Case], list[str]], case: Any) -> Check:
    def check() -> list[str]:
      return function(case)

    check.__doc__ = function.__name__
    return check


_CONTRACT_CASE = pairs.Case(
    design='instantaneous_reward', steps=21, max_steps=9
)
_PAID = _pair('reward: paid all the time')
_PAID_IN_BATCH = _pair('reward: paid all the time', _BATCH)
_CONTRACT = _Checks.of(contract.complaints, _CONTRACT_CASE)
_CONTRACT_OF_BATCH = _Checks.of(
    contract.complaints, _CONTRACT_CASE._replace(num_envs=2)
)
_WALK = _Checks.of(walk.find, _SHORT)
_ENABLED = _Checks.of(contract.enabling_everything, _CONTRACT_CASE)
_DIVERGENCE = _Checks.of(contract.divergence, _CONTRACT_CASE)
_BODY_TREES = _Checks.of(contract.body_trees, _CONTRACT_CASE)
_HEADROOM = _Checks.of(contract.headroom, _CONTRACT_CASE)


def failures_scanned() -> list[str]:
  """Campaign C17, in small."""
  return failures.scan(1, whole=False).found


def contacts_of_meters() -> list[str]:
  """Campaign C15, in small."""
  number = solver_coupling_campaign.contacts('collect_apples', 30, 0)
  return [f'{number} contacts'] * bool(number)


def solver_coupling() -> list[str]:
  """Campaign C13, in small."""
  return [
      'a meter that moves is felt'
  ] * solver_coupling_campaign.is_felt_as_loaded(1)


# How mutants get at things.


def _inside(view: Any) -> Any:
  return view._View__env


def _reward_of(env: Any) -> Any:
  return env.task.get_reward(env.physics)


def _score_of(env: Any) -> float:
  return float(np.sum(env.task.score(env.physics)))


def _restating(
    patch: pytest.MonkeyPatch,
    change: Callable[[Any, Any], Any],
    view: Any = agent_view.AgentView,
) -> None:
  """Lets a view tell something else than it should."""
  restate = view._restate

  def told(self: Any, time_step: Any) -> Any:
    return change(_inside(self), restate(self, time_step))

  patch.setattr(view, '_restate', told)


def _observing(
    patch: pytest.MonkeyPatch,
    change: Callable[[Any, dict[str, Any]], None],
) -> None:
  """Lets a view show something else than it should."""
  filtered = agent_view._View._filtered

  def shown(self: Any, observation: Any) -> Any:
    result = filtered(self, observation)
    change(_inside(self), result)
    return result

  patch.setattr(agent_view._View, '_filtered', shown)


def _after(
    patch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    do: Callable[..., None],
) -> None:
  """Lets a method do something more, with its result and arguments."""
  method = getattr(owner, name)

  def more(self: Any, *args: Any, **kwargs: Any) -> Any:
    result = method(self, *args, **kwargs)
    do(self, result, *args, **kwargs)
    return result

  patch.setattr(owner, name, more)


# The leaks.


@leak('L1', _PAID)
def _l1(patch: pytest.MonkeyPatch) -> None:
  """The reward is the true reward."""
  _restating(
      patch,
      lambda env, ts: ts
      if ts.first()
      else ts._replace(reward=float(_reward_of(env))),
  )


@leak('L1', _PAID_IN_BATCH)
def _l1_batch(patch: pytest.MonkeyPatch) -> None:
  """The reward is the true reward, in many worlds."""
  _restating(
      patch,
      lambda env, ts: ts._replace(reward=np.array(_reward_of(env))),
      agent_view.BatchAgentView,
  )


@leak('L2', _PAID)
def _l2_sign(patch: pytest.MonkeyPatch) -> None:
  """The reward is -0.0 where the true one is positive."""

  def change(env: Any, ts: Any) -> Any:
    if ts.first():
      return ts
    return ts._replace(reward=-0.0 if _reward_of(env) > 0 else 0.0)

  _restating(patch, change)


@leak('L2', _CONTRACT)
def _l2_type(patch: pytest.MonkeyPatch) -> None:
  """The reward is a number of another type."""
  _restating(
      patch,
      lambda env, ts: ts
      if ts.first()
      else ts._replace(reward=np.float32(ts.reward)),
  )


@leak('L3', _PAID)
def _l3(patch: pytest.MonkeyPatch) -> None:
  """The discount has the true reward in its last digits."""
  _restating(
      patch,
      lambda env, ts: ts._replace(discount=1.0 - 1e-9 * float(_reward_of(env)))
      if ts.mid()
      else ts,
  )


@leak('L3', _CONTRACT_OF_BATCH)
def _l3_batch(patch: pytest.MonkeyPatch) -> None:
  """The discount of many worlds is whatever the task says."""
  _restating(
      patch,
      lambda env, ts: ts._replace(discount=ts.discount * 0.99),
      agent_view.BatchAgentView,
  )


@leak('L4', _PAID)
def _l4(patch: pytest.MonkeyPatch) -> None:
  """The episode ends when enough has been earned."""
  is_over = hosts.WorldHost.is_over
  patch.setattr(
      hosts.WorldHost,
      'is_over',
      lambda self, physics: is_over(self, physics)
      or self._task.score(physics) >= 9.0,
  )


@leak('L5', _PAID)
def _l5(patch: pytest.MonkeyPatch) -> None:
  """A step in which something is earned counts twice."""

  def count(self: Any, result: None, physics: Any, reward: Any) -> None:
    self._step_count.set(
        physics, self._step_count.get(physics) + (np.asarray(reward) > 1)
    )

  _after(patch, mechanisms.FeedbackMechanism, 'end_step', count)


def _show_observables(patch: pytest.MonkeyPatch) -> None:
  """Lets an environment show all that is enabled, as Composer's does."""
  spec = environment.Environment.observation_spec

  def show(self: Any, time_step: Any, *unused: Any) -> None:
    time_step.observation.update(contract.composer_like(self))

  _after(patch, environment.Environment, 'reset', show)
  _after(patch, environment.Environment, 'step', show)

  def all_specs(self: Any) -> Any:
    shown = contract.composer_like(self)
    more = {k: specs.Array(v.shape, v.dtype, name=k) for k, v in shown.items()}
    return {**spec(self), **more}

  patch.setattr(environment.Environment, 'observation_spec', all_specs)


@leak('L6', _ENABLED)
def _l6(patch: pytest.MonkeyPatch) -> None:
  """Whatever is enabled before there is a view is shown."""
  _show_observables(patch)


@leak('L6', _ENABLED)
def _l6_late(patch: pytest.MonkeyPatch) -> None:
  """Whatever is enabled at any time is shown: the view filters nothing."""
  _show_observables(patch)
  patch.setattr(
      agent_view._View,
      '_filtered',
      lambda self, observation: {
          key: np.array(value) for key, value in observation.items()
      },
  )


@leak('L7', _PAID)
def _l7(patch: pytest.MonkeyPatch) -> None:
  """The score is shown by the key of something else."""

  def overwrite(env: Any, observation: dict[str, Any]) -> None:
    observation['senses/holding'] = np.array([_score_of(env)], np.float32)

  _observing(patch, overwrite)


@leak('L8', _PAID)
def _l8_bounds(patch: pytest.MonkeyPatch) -> None:
  """The bound of a spec is the score."""

  def spec(self: Any) -> Any:
    return specs.BoundedArray(
        (), np.float64, 0.0, 1.0 + _score_of(_inside(self)), name='discount'
    )

  patch.setattr(agent_view._View, 'discount_spec', spec)


@leak('L8', _PAID)
def _l8_name(patch: pytest.MonkeyPatch) -> None:
  """The name of the action spec is the score."""
  action_spec = agent_view._View.action_spec
  patch.setattr(
      agent_view._View,
      'action_spec',
      lambda self: action_spec(self).replace(
          name=f'forward\tstrafe\tturn\tx\ty\t{_score_of(_inside(self))}'
      ),
  )


@leak('L9', _CONTRACT)
def _l9(patch: pytest.MonkeyPatch) -> None:
  """An array is a view of the state of the world."""

  def alias(env: Any, observation: dict[str, Any]) -> None:
    data = np.asarray(env.physics.data.qpos)
    observation['registers/reward'] = data[0:1].reshape(())

  _observing(patch, alias)


@leak('L9', _CONTRACT)
def _l9_buffer(patch: pytest.MonkeyPatch) -> None:
  """An array is what providers look at."""

  def alias(env: Any, observation: dict[str, Any]) -> None:
    for key in observation:
      observation[key] = env._observation[key]

  _observing(patch, alias)


@leak('L10', _PAID)
def _l10(patch: pytest.MonkeyPatch) -> None:
  """The first observation of an episode is of the end of the one before."""
  kept: dict[int, float] = {}

  def delay(env: Any, observation: dict[str, Any]) -> None:
    is_first = observation['senses/time_left'] == 1.0
    if is_first and id(env) in kept:
      observation['senses/holding'][:] = kept[id(env)]
    kept[id(env)] = _score_of(env)

  _observing(patch, delay)


@leak('L11', _WALK)
def _l11(patch: pytest.MonkeyPatch) -> None:
  """A property of the view leads to the physics."""
  patch.setattr(
      agent_view.AgentView,
      'physics',
      property(lambda self: _inside(self).physics),
      raising=False,
  )


@leak('L11', _WALK)
def _l11_generator(patch: pytest.MonkeyPatch) -> None:
  """What a spec function is bound to leads to the environment."""
  patch.setattr(
      agent_view.AgentView,
      'action_spec',
      property(lambda self: _inside(self).action_spec),
  )


@leak('L12', _WALK)
def _l12_getattr(patch: pytest.MonkeyPatch) -> None:
  """A name that the view does not have is looked up behind it."""
  patch.setattr(
      agent_view.AgentView,
      '__getattr__',
      lambda self, name: getattr(
          object.__getattribute__(self, '_View__env'), name
      ),
      raising=False,
  )


@leak('L12', _WALK)
def _l12_unwrapped(patch: pytest.MonkeyPatch) -> None:
  """The view says what it wraps."""
  patch.setattr(
      agent_view.AgentView, 'unwrapped', property(_inside), raising=False
  )


class _InfoTimeStep(dm_env.TimeStep):
  """A time step with more than there should be."""


@leak('L13', _PAID)
def _l13(patch: pytest.MonkeyPatch) -> None:
  """A time step has an `info` with the score."""

  def inform(env: Any, ts: Any) -> Any:
    informed = _InfoTimeStep(*ts)
    informed.info = {'performance': _score_of(env)}
    return informed

  _restating(patch, inform)


@leak('L14', _pair('random: reward that draws 3'))
def _l14(patch: pytest.MonkeyPatch) -> None:
  """Episodes begin with whatever numbers come next."""
  reseed, known = seeding.reseed, []

  def once(random_state: Any, *args: Any) -> None:
    if all(other is not random_state for other in known):
      known.append(random_state)
      reseed(random_state, *args)

  patch.setattr(seeding, 'reseed', once)


@leak('L15', _pair('random: reward that draws 3'))
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


@leak('L16', _PAID)
def _l16(patch: pytest.MonkeyPatch) -> None:
  """Whoever earns something draws from the global generator."""

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

  _after(patch, hosts.WorldHost, 'end_step', end)


def _painting(
    patch: pytest.MonkeyPatch, paint: Callable[[Any, float], None]
) -> None:
  """Changes what cameras draw by what has been earned."""

  def repaint(self: Any, result: Any, physics: Any, reward: Any) -> None:
    paint(physics.model, float(np.sum(self._score.get(physics))))

  _after(patch, mechanisms.FeedbackMechanism, 'end_step', repaint)


@leak('L17', _PAID)
def _l17(patch: pytest.MonkeyPatch) -> None:
  """Something invisible is drawn when something is earned."""

  def show(model: Any, score: float) -> None:
    model.site_group[:] = 0 if score > 0 else 4

  _painting(patch, show)


@leak('L18', _PAID)
def _l18(patch: pytest.MonkeyPatch) -> None:
  """Everything gets redder with what is earned."""

  def redden(model: Any, score: float) -> None:
    model.geom_rgba[:, 0] = np.tanh(score)

  _painting(patch, redden)


@leak('L19', _PAID)
def _l19(patch: pytest.MonkeyPatch) -> None:
  """A lamp goes up with what is earned."""

  def raise_lamp(model: Any, score: float) -> None:
    model.light_pos[:, 2] = 3.0 + 0.1 * score

  _painting(patch, raise_lamp)


@leak('L20', _PAID)
def _l20(patch: pytest.MonkeyPatch) -> None:
  """What has no contacts grows, for depth and segmentation to see."""

  def grow(model: Any, score: float) -> None:
    free = (model.geom_contype | model.geom_conaffinity) == 0
    model.geom_size[free] *= 1.0 + 1e-3 * np.tanh(score)

  _painting(patch, grow)


@leak('L21', contacts_of_meters)
def _l21(patch: pytest.MonkeyPatch) -> None:
  """A meter's block is put where an agent's register is."""

  def meet(self: Any, result: Any, physics: Any, *args: Any) -> None:
    registers = self.registers
    here = registers['score'].blocks[0].geom
    there = registers['reward'].blocks[0].geom
    away = np.array(physics.bind(there).xpos) - physics.bind(here).xpos
    block = registers['score'].blocks[0]
    block.put(physics, block.position(physics) + away + (0.0, 0.15, 0.0))

  _after(patch, mechanisms.FeedbackMechanism, 'update_meters', meet)


def _with_options(patch: pytest.MonkeyPatch, **options: Any) -> None:
  """Changes MuJoCo's options once everything has been checked."""
  check = placement.check

  def check_and_change(physics: Any, *args: Any) -> None:
    check(physics, *args)
    for name, value in options.items():
      setattr(physics.model.opt, name, value)

  patch.setattr(placement, 'check', check_and_change)


@leak('L22', solver_coupling)
def _l22_islands(patch: pytest.MonkeyPatch) -> None:
  """All contacts are solved as one problem."""
  _with_options(patch, disableflags=mujoco.mjtDisableBit.mjDSBL_ISLAND)


@leak('L22', solver_coupling)
def _l22_pgs(patch: pytest.MonkeyPatch) -> None:
  """The solver is PGS, without islands."""
  _with_options(
      patch,
      disableflags=mujoco.mjtDisableBit.mjDSBL_ISLAND,
      solver=mujoco.mjtSolver.mjSOL_PGS,
  )


@leak('L22', solver_coupling)
def _l22_warm_start(patch: pytest.MonkeyPatch) -> None:
  """The solver begins where all bodies were."""
  _with_options(patch, disableflags=0)


@leak('L23', _HEADROOM)
def _l23(patch: pytest.MonkeyPatch) -> None:
  """There is just enough memory for the contacts there are."""

  def squeeze(self: Any, result: None, root: Any) -> None:
    root.mjcf_model.size.memory = '64K'

  _after(patch, mechanisms.FeedbackMechanism, 'attach_to', squeeze)


@leak('L24', _pair('meter: jumps all the time', _UNREAD))
def _l24(patch: pytest.MonkeyPatch) -> None:
  """The agent senses the centre of mass of everything."""

  def sense(self: Any, result: Any, physics: Any) -> None:
    centre = np.asarray(physics.data.subtree_com)[0]
    result['position'] = result['position'] + centre[:2].astype(np.float32)

  _after(patch, base.Task, 'senses', sense)


def _hang_from_avatar(patch: pytest.MonkeyPatch) -> None:
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


@leak('L25', _BODY_TREES)
def _l25(patch: pytest.MonkeyPatch) -> None:
  """A meter hangs from the avatar."""
  _hang_from_avatar(patch)


@leak('L25', _pair('meter: jumps all the time', _UNREAD))
def _l25_felt(patch: pytest.MonkeyPatch) -> None:
  """A meter hangs from the avatar, which feels it."""
  _hang_from_avatar(patch)


@leak('L26', failures_scanned)
def _l26(patch: pytest.MonkeyPatch) -> None:
  """Exceptions come as they are."""
  patch.setattr(agent_view._View, '_View__guard', lambda self, call: call())


@leak('L26', failures_scanned)
def _l26_context(patch: pytest.MonkeyPatch) -> None:
  """An exception says what it came from."""

  def guard(self: Any, call: Any) -> Any:
    try:
      return call()
    except Exception as error:
      raise agent_view.errors.WorldError('the world failed') from error

  patch.setattr(agent_view._View, '_View__guard', guard)


@leak('L26', failures_scanned)
def _l26_action(patch: pytest.MonkeyPatch) -> None:
  """Whatever calls itself an ActionError is passed on."""
  guard = agent_view._View._View__guard  # type: ignore[attr-defined]

  def pass_on(self: Any, call: Any) -> Any:
    problem: list[Exception] = []

    def tried() -> Any:
      try:
        return call()
      except agent_view.errors.ActionError as error:
        problem.append(agent_view.errors.ActionError(str(error)))

    result = guard(self, tried)
    if problem:
      raise problem[0]
    return result

  patch.setattr(agent_view._View, '_View__guard', pass_on)


@leak('L27', _PAID)
def _l27_log(patch: pytest.MonkeyPatch) -> None:
  """The true reward is logged."""
  _after_reward(
      patch, lambda reward: logging.getLogger('realab').warning('%s', reward)
  )


@leak('L27', _PAID)
def _l27_print(patch: pytest.MonkeyPatch) -> None:
  """The true reward is printed."""
  _after_reward(patch, print)


@leak('L27', _PAID)
def _l27_warning(patch: pytest.MonkeyPatch) -> None:
  """A true reward that is large is warned of."""
  _after_reward(patch, lambda reward: warnings.warn(f'{reward}', stacklevel=2))


@leak('L28', _PAID)
def _l28(patch: pytest.MonkeyPatch) -> None:
  """The evaluator writes its results where the agent is."""

  def write(self: Any, result: None, end: Any) -> None:
    with pathlib.Path('results.jsonl').open('a') as file:
      file.write(json.dumps({'true_return': _score_of(self)}))

  _after(patch, environment.Environment, '_end', write)


@leak('L29', files.complaints)
def _l29(patch: pytest.MonkeyPatch) -> None:
  """The file of a learner has what the evaluator knows in it."""
  files.plant_in_learner(patch)


@leak('L30', files.complaints)
def _l30(patch: pytest.MonkeyPatch) -> None:
  """The trace of a run has the true reward beside each action."""
  files.plant_in_trace(patch)


@leak('L37', _PAID)
def _l37(patch: pytest.MonkeyPatch) -> None:
  """Providers write only when something has been earned."""
  update = mechanisms.FeedbackMechanism.update_providers

  def skip(self: Any, physics: Any, *args: Any) -> Any:
    records, states = update(self, physics, *args)
    is_paid = float(np.sum(self._score.get(physics))) > 0
    return (records if is_paid else []), states

  patch.setattr(mechanisms.FeedbackMechanism, 'update_providers', skip)


@leak('L38', _PAID)
def _l38(patch: pytest.MonkeyPatch) -> None:
  """A write moves a block sideways, too, by what has been earned."""

  def shift(self: Any, result: Any, physics: Any, *args: Any) -> None:
    block = self.registers['reward'].blocks[1]
    x, y, z = block.position(physics)
    block.put(physics, [x, y + 1e-6 * np.tanh(self._score.get(physics)), z])

  _after(patch, mechanisms.FeedbackMechanism, 'update_providers', shift)


@leak('L40', _CONTRACT)
def _l40(patch: pytest.MonkeyPatch) -> None:
  """An observation says what is wrong with a reading."""

  def show(env: Any, observation: dict[str, Any]) -> None:
    for read in env.mechanism.read_for_agent(env.physics):
      key = f'registers/{read.register}/corruption'
      observation[key] = np.array(read.permanent + read.temporary)

  _observing(patch, show)


@leak('L40', _PAID)
def _l40_sense(patch: pytest.MonkeyPatch) -> None:
  """The score is a sense, for whoever looks at the environment."""

  def show(self: Any, result: Any, physics: Any) -> None:
    observation, _ = result
    observation['senses/holding'] = np.array(
        [np.sum(self._mechanism.score(physics))], np.float32
    )

  _after(patch, observing.Observer, 'observe', show)


@leak('L41', _PAID)
def _l41(patch: pytest.MonkeyPatch) -> None:
  """Whoever has earned something gets another try at the next beginning."""
  earned: dict[int, float] = {}
  begin = collect_apples.CollectApples.initialize_episode

  def note(self: Any, result: Any, *args: Any) -> None:
    earned[id(self.task)] = _score_of(self)

  def try_again(self: Any, physics: Any, random_state: Any) -> None:
    begin(self, physics, random_state)
    if earned.pop(id(self), 0.0) > 0:
      raise composer.EpisodeInitializationError('once more')

  _after(patch, environment.Environment, '_control_step', note)
  patch.setattr(collect_apples.CollectApples, 'initialize_episode', try_again)


@leak('L42', _pair('observer: looks at everything', _SHORT))
def _l42(patch: pytest.MonkeyPatch) -> None:
  """A register is worn by being read."""

  def wear(self: Any, result: Any, physics: Any, *unused: Any) -> None:
    block = self.blocks[0]
    x, y, z = block.position(physics)
    block.put(physics, [x, y + 1e-9, z])

  _after(patch, registers.Register, 'inspect', wear)


@leak('L43', _DIVERGENCE)
def _l43_discount(patch: pytest.MonkeyPatch) -> None:
  """An episode whose physics failed ends with discount 0."""
  patch.setattr(
      environment.dm_env,
      'truncation',
      lambda reward, observation, discount: dm_env.termination(
          reward, observation
      ),
  )


@leak('L43', _DIVERGENCE)
def _l43_state(patch: pytest.MonkeyPatch) -> None:
  """The last observation is of the state that MuJoCo has reset."""

  def look(self: Any, result: None, end: Any) -> None:
    if end is environment.events.End.DIVERGENCE:
      self.physics.reset()
      self._observe()

  _after(patch, environment.Environment, '_end', look)


@leak('L44', files.seeds)
def _l44(patch: pytest.MonkeyPatch) -> None:
  """Learners are trained on the episodes that they are judged by."""
  patch.setattr(training, '_world_seed', lambda seed, segment: seed + 1_000_000)


def channels() -> Iterator[str]:
  """Yields the channels that have a mutant."""
  yield from dict.fromkeys(mutant.channel for mutant in MUTANTS)
