"""Audits beside the rows of a study: is the design of a run exploitable?"""

from collections.abc import Mapping
import json
from typing import Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite.evaluation import actors
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import verdicts

# Keys of a design that do not change what can be exploited. What the learner
# maximises, and what it asks for, is compared apart from its other settings.
_FREE = frozenset({'name', 'description', 'learner'})
_OF_WORLD = ('max_steps', 'task_kwargs', 'senses')


def of(
    place: str,
    content: Any,
    config: Mapping[str, Any],
    design: specs.DesignSpec,
) -> verdicts.Audit | None:
  """Returns what an audit says of the design of a run.

  Nothing can change the values of the channel `secure`, so it needs no audit.

  Args:
    place: Where the audit is from, for messages.
    content: Content of the file of the launcher `audit`, or `None`.
    config: Configuration of the run.
    design: Its design.

  Raises:
    ResultsError: If the audit is not valid, or belongs to another design or
      world.
  """
  if design.channel == 'secure':
    return verdicts.Audit(False, True, 0)
  if content is None:
    return None
  try:
    audit = _Content.model_validate(content, strict=True)
  except pydantic.ValidationError as error:
    raise errors.ResultsError(
        f'{place}: {first_problem(error)}, as in a file that the present'
        ' version of the program audit has written'
    ) from error
  _check_subject(place, audit, config, design)
  return verdicts.Audit(
      is_exploitable=audit.verdict == 'EXPLOITABLE',
      is_sufficient=audit.is_sufficient and audit.verdict != 'UNDECIDED',
      num_searched=audit.num_searched,
  )


def first_problem(error: pydantic.ValidationError) -> str:
  """Returns the first problem of a file: its key, its value, what is wrong."""
  first = error.errors()[0]
  key = '.'.join(map(str, first['loc'])) or 'contents'
  return f'{key}: {first["input"]!r:.80}; {first["msg"]}'


@final
class _Content(pydantic.BaseModel):
  """The part of an audit's file that decides about labels."""

  verdict: Literal['EXPLOITABLE', 'RESISTED WITHIN BUDGET', 'UNDECIDED']
  is_sufficient: bool
  num_searched: int
  world: dict[str, Any]
  design: dict[str, Any]
  objective: dict[str, Any]
  target: str | None = None
  query_policy: str | None = None


def _check_subject(
    place: str,
    audit: _Content,
    config: Mapping[str, Any],
    design: specs.DesignSpec,
) -> None:
  """Checks that an audit is of the design and the world of a run.

  Settings of the learner that neither change its objective nor its queries are
  those of training, and may differ.

  Raises:
    ResultsError: If it is not, or is of one register only.
  """
  senses = config.get('environment_kwargs', {}).get('senses')
  objective = design.objective and design.objective.model_dump(mode='json')
  audited = {
      'task': f'{audit.world.get("domain")}.{audit.world.get("task")}',
      **{key: audit.world.get(key) for key in _OF_WORLD},
      'target': audit.target,
      **_of_design(audit.design),
      'the objective': audit.objective,
      'the query policy': audit.query_policy,
  }
  expected = {
      'task': config['task'],
      'max_steps': config['max_steps'],
      'task_kwargs': config.get('task_kwargs', {}),
      'senses': senses and list(senses),
      'target': None,
      **_of_design(json.loads(json.dumps(design.to_mapping()))),
      'the objective': objective,
      'the query policy': actors.query_policy(design),
  }
  for key in {**expected, **audited}:
    value, needed = audited.get(key), expected.get(key)
    if value != needed:
      raise errors.ResultsError(
          f'{place} is of another one: {key} is'
          f' {value!r:.120}, and {needed!r:.120} in the run'
      )


def _of_design(design: Mapping[str, Any]) -> dict[str, Any]:
  """Returns the part of a design that an audit depends on."""
  kind = (design.get('learner') or {}).get('kind')
  kept = {f'design.{k}': v for k, v in design.items() if k not in _FREE}
  return {'design.learner.kind': kind, **kept}
