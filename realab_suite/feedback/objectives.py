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
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal, final

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
      raise ValueError(
          f'registers: the weight of {zero[0]!r} is 0; allowed are others'
      )
    if self.discount is not None and self.kind != RETURN:
      raise ValueError(
          f'discount: {self.discount} for a {self.kind}; allowed is a return'
      )
    if self.kind == AGREEMENT and list(self.registers.values()) != [1.0]:
      raise ValueError(
          f'registers: {self.registers} for an agreement; allowed is one'
          ' register with weight 1'
      )
    return self


_Options = Mapping[str, Any]
OBJECTIVES: registry.Registry[Callable[[_Options], dict[str, Any] | None]] = (
    registry.Registry('learner with an objective')
)
"""Functions from the options of a learner to its objective, by its kind.

`None` means that these options make it maximise no function of readings. A
`KeyError` means that an option is missing.
"""


@OBJECTIVES.add('policy_gradient')
@OBJECTIVES.add('q_learning')
def _return(options: _Options) -> dict[str, Any] | None:
  registers = {_name(options, 'reward'): 1.0}
  objective = {
      'kind': RETURN,
      'registers': registers,
      'discount': options.get('gamma', DEFAULT_DISCOUNT),
  }
  given = options.get('defence')
  defence: _Options = given if isinstance(given, Mapping) else {}
  if defence.get('kind') == 'mona':
    # Approval is paid beside the reward.
    if weight := defence.get('weight', 1.0):
      registers[_name(defence, 'approval')] = weight
    objective['queries'] = [_name(defence, 'query')]
  kind, source = defence.get('kind'), defence.get('source')
  if kind == 'learned_reward' and source == 'comparisons':
    # They compare the agent with itself, so their sum is not what it earns.
    return None
  return objective


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


def _name(options: _Options, option: str) -> str:
  """Returns the name of a register in an option of a learner."""
  name = options[option]
  if not isinstance(name, str):
    raise ValueError(
        f'learner.{option}: must be the name of a register, got'
        f' {messages.quote(name)}'
    )
  return name


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
        ' it; allowed is none'
    )
  else:
    where = 'learner'
    try:
      declared = OBJECTIVES.get(learner.kind)(options)
    except KeyError as error:
      raise ValueError(
          f'learner.{error.args[0]}: required key is missing'
      ) from error
    if declared is None:
      reason = f'learner {learner.kind!r} learns a reward from comparisons'
      return None, f'{reason}, whose sum says nothing'
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
