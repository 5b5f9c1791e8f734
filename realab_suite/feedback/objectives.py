"""Objectives: what learners maximise, as functions of readings.

Tampering is judged by what it does for the objective of the learner. An
objective is therefore declared by the kind of the learner, and never guessed
from the names of its options. A learner of another package declares its own,
for its kind,

    @objectives.OBJECTIVES.add('my_learner')
    def _objective(options):
      return {'kind': 'return', 'registers': {options['target']: 1.0}}

or in the design:

    learner:
      kind: my_learner
      objective: {kind: return, registers: {cost: -1.0}}

A defence may pay a learner from other registers than its reward. Defences of
this package declare that here, because evaluators do not need JAX; a class of
another package declares it by `Defence.pays`.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple, final

import pydantic

from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.config import validation

RETURN: Final = 'return'
MEAN: Final = 'mean'
AGREEMENT: Final = 'agreement'

DEFAULT_DISCOUNT: Final = 0.97
"""Discount of learners that maximise a return, unless they have another one."""

_Weight = Annotated[float, pydantic.Field(ge=-1e9, le=1e9)]
_Discount = Annotated[float, pydantic.Field(ge=0, le=1)]


@final
class ObjectiveSpec(validation.Spec):
  """Objective of a learner.

  Attributes:
    kind: `return` for the sum of readings, `mean` for their mean, `agreement`
      for the share of steps in which the reading, rounded to the index of an
      action, is the action of the agent.
    registers: Weight of the reading of each register, by name. The sign is the
      direction that pays.
    discount: Discount of the learner, for a return; `None` for 1.
    queries: Query registers in which an agent names its own action; the other
      ones hold independent actions. `None` for all of them.
  """

  kind: Literal['return', 'mean', 'agreement']
  registers: Annotated[dict[str, _Weight], pydantic.Field(min_length=1)]
  discount: _Discount | None = None
  queries: Annotated[tuple[str, ...], pydantic.Field(strict=False)] | None = (
      None
  )

  @pydantic.model_validator(mode='after')
  def _consistent(self) -> 'ObjectiveSpec':
    if zero := [name for name, weight in self.registers.items() if not weight]:
      raise ValueError(f'registers: the weight of {zero[0]!r} must not be 0')
    if self.discount is not None and self.kind != RETURN:
      raise ValueError(
          f'discount: {self.discount} for a {self.kind}; only a return has one'
      )
    if self.kind == AGREEMENT and list(self.registers.values()) != [1.0]:
      raise ValueError(
          f'registers: {self.registers} for an agreement; must be one'
          ' register with weight 1'
      )
    return self


_Options = Mapping[str, Any]
OBJECTIVES: registry.Registry[Callable[[_Options], dict[str, Any] | str]] = (
    registry.Registry('learner with an objective')
)
"""Functions from the options of a learner to its objective, by its kind.

A string is the reason why these options make it maximise no function of
readings. A `KeyError` means that an option is missing.
"""


@final
class Payment(NamedTuple):
  """Readings that a learner with a defence is paid.

  Attributes:
    registers: Weight of each register in the sum.
    queries: Same as in `ObjectiveSpec`.
  """

  registers: Mapping[str, float]
  queries: tuple[str, ...] | None = None


PAYMENTS: registry.Registry[Callable[[_Options, str], Payment | str]] = (
    registry.Registry('defence of this package')
)
"""Functions from the options of a defence and the name of the reward, by kind.

A string is the reason why there is no such sum.
"""

LEARNERS: registry.Registry[type[Any]] = registry.Registry('learner')
"""Classes of learners, by kind; `agents` fills it when imported."""

DEFENCES: registry.Registry[type[Any]] = registry.Registry('defence')
"""Classes of defences, by kind; `agents.defences` fills it when imported."""

# Likeness from which an unknown kind is taken for a misspelling of a known one.
_MISSPELT = 0.8


@PAYMENTS.add('alarm')
@PAYMENTS.add('cap')
@PAYMENTS.add('orpo')
def _reward_alone(options: _Options, reward: str) -> Payment:
  del options
  return Payment({reward: 1.0})


@PAYMENTS.add('learned_reward')
def _prediction(options: _Options, reward: str) -> Payment | str:
  if options.get('source') == 'comparisons':
    # They compare the agent with itself, so their sum is not what it earns.
    return 'learns a reward from comparisons, whose sum says nothing'
  return Payment({reward: 1.0})


@PAYMENTS.add('mona')
def _approval_beside(options: _Options, reward: str) -> Payment:
  approval = _name(options, 'approval', 'defence.')
  if approval == reward:
    raise ValueError(
        f'defence.approval: {approval!r}; must be another register than that'
        ' of the reward'
    )
  weights = {reward: 1.0, approval: options.get('weight', 1.0)}
  return Payment(weights, (_name(options, 'query', 'defence.'),))


def why_unknown(defence: Any) -> str | None:
  """Returns why nothing is known about a defence, or `None` if it is known.

  Args:
    defence: Options of the defence, or `None`.
  """
  if not isinstance(defence, Mapping):
    return None
  kind: Any = defence.get('kind')
  kinds = sorted({*PAYMENTS, *DEFENCES})
  if isinstance(kind, str) and kind in kinds:
    return None
  return (
      f'has the defence {messages.quote(kind)}, which is not registered'
      f'{messages.did_you_mean(kind, kinds)}; known are {kinds}, and --import'
      ' names the module of another'
  )


def _payment(defence: Any, reward: str) -> Payment | str:
  """Returns the payment of a learner, or the reason why it is not known.

  Args:
    defence: Options of the defence, or `None`.
    reward: Name of the register that the learner reads.
  """
  if defence is None:
    return Payment({reward: 1.0})
  if not isinstance(defence, Mapping):
    raise ValueError(
        f'learner.defence: {messages.quote(defence)}; must be a mapping'
        ' with a kind, or null'
    )
  kind: Any = defence.get('kind')
  is_name = isinstance(kind, str)
  if is_name and kind in PAYMENTS:
    return PAYMENTS.get(kind)(defence, reward)
  if unknown := why_unknown(defence):
    return unknown
  spec = validation.validate(DEFENCES.get(kind), defence, 'learner.defence')
  if (weights := spec.pays(reward)) is None:
    return (
        f'has the defence {kind!r}, which declares no sum of readings that it'
        ' pays (`pays` in docs/your_own.md)'
    )
  if not isinstance(weights, Mapping) or not any(weights.values()):
    raise ValueError(
        f'defence {kind!r}: pays {messages.quote(weights)}; must map to weights'
        ' by the name of the register, one of which is not 0'
    )
  return Payment(weights, tuple(spec.queries) or None)


@OBJECTIVES.add('policy_gradient')
@OBJECTIVES.add('q_learning')
def _return(options: _Options) -> dict[str, Any] | str:
  payment = _payment(options.get('defence'), _name(options, 'reward'))
  if isinstance(payment, str):
    return payment
  return {
      'kind': RETURN,
      'registers': {name: w for name, w in payment.registers.items() if w},
      'discount': options.get('gamma', DEFAULT_DISCOUNT),
      'queries': payment.queries,
  }


@OBJECTIVES.add('value_advice')
def _advice(options: _Options) -> dict[str, Any]:
  return {
      'kind': MEAN,
      'registers': {_name(options, 'advice'): 1.0},
      'queries': [_name(options, 'query')],
  }


@OBJECTIVES.add('decoupled_approval')
def _approval(options: _Options) -> dict[str, Any]:
  return {
      'kind': MEAN,
      'registers': {_name(options, 'approval'): 1.0},
      'queries': [_name(options, 'query')],
  }


@OBJECTIVES.add('behavioural_cloning')
def _imitation(options: _Options) -> dict[str, Any]:
  registers = {_name(options, 'demonstration'): 1.0}
  return {'kind': AGREEMENT, 'registers': registers}


def _name(options: _Options, option: str, owner: str = '') -> str:
  """Returns the name of a register in an option of a learner.

  Args:
    options: Options of the learner, or of its defence.
    option: The option.
    owner: Path of the options in those of the learner, with a dot.

  Raises:
    KeyError: If the option is missing.
    ValueError: If it is no name.
  """
  if option not in options:
    raise KeyError(f'{owner}{option}')
  name = options[option]
  if not isinstance(name, str):
    raise ValueError(
        f'learner.{owner}{option}: must be the name of a register, got'
        f' {messages.quote(name)}'
    )
  return name


def refuse_misspelling(kind: str) -> None:
  """Refuses the kind of a learner that is almost a known one.

  Other unknown kinds may be those of algorithms that this package never runs.

  Args:
    kind: Kind of a learner without an objective.

  Raises:
    ValueError: If it is unknown, and like a known one.
  """
  kinds = sorted({*OBJECTIVES, *LEARNERS})
  hint = messages.did_you_mean(kind, kinds, _MISSPELT)
  if hint and kind not in kinds:
    raise ValueError(
        f'learner {messages.quote(kind)} is unknown{hint}; known are'
        f' {kinds}; a learner of your own that has such a name declares an'
        ' `objective`, or --import names its module'
    )


def refuse_misspelt_defence(defence: Any) -> None:
  """Refuses the kind of a defence that is almost a known one.

  Args:
    defence: Options of the defence, or `None`.

  Raises:
    ValueError: If its kind is unknown, and like a known one.
  """
  reason = why_unknown(defence)
  if reason and messages.did_you_mean(
      defence.get('kind'), {*PAYMENTS, *DEFENCES}, _MISSPELT
  ):
    raise ValueError(f'learner {reason}')


def of_learner(learner: Any) -> tuple[ObjectiveSpec | None, str]:
  """Returns the objective of a learner, or `None` and the reason.

  Args:
    learner: A `specs.LearnerSpec`, or `None`.

  Raises:
    ValueError: If the objective is invalid, an option that it depends on is
      missing, or a learner with an objective of its kind declares another one.
  """
  if learner is None:
    return None, 'the design has no learner'
  options = dict(learner.model_extra or {})
  declared = options.pop('objective', None)
  if learner.kind not in OBJECTIVES:
    if declared is None:
      return None, (
          f'learner {learner.kind!r} declares no objective ("An objective" in'
          ' docs/your_own.md)'
      )
    where = 'learner.objective'
  elif declared is not None:
    raise ValueError(
        f'learner.objective: given for {learner.kind!r}, whose kind declares'
        ' it; leave it out'
    )
  else:
    where = 'learner'
    try:
      declared = OBJECTIVES.get(learner.kind)(options)
    except KeyError as error:
      raise ValueError(
          f'learner.{error.args[0]}: required key is missing'
      ) from error
    if isinstance(declared, str):
      return None, f'learner {learner.kind!r} {declared}'
  try:
    return ObjectiveSpec.model_validate(declared), ''
  except pydantic.ValidationError as error:
    first = error.errors(include_url=False)[0]
    # The discount of an objective is an option of the learners of this package.
    path = *where.split('.'), *first['loc']
    if path == ('learner', 'discount'):
      path = 'learner', 'gamma'
    problem = f'{first["msg"]}, got {messages.quote(first["input"])}'
    if first['type'] == 'value_error':
      problem = str(first['ctx']['error'])
    raise ValueError(f'{messages.format_path(path)}: {problem}') from error
