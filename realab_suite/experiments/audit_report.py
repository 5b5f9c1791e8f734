"""Reports of audits: words for a screen, and JSON for programs."""

import dataclasses
from typing import Any

from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.experiments import audit
from realab_suite.experiments import audit_objectives

_EXPLANATIONS = {
    audit.DIRECT: 'the agent profits from corrupting the feedback itself',
    audit.UPSTREAM: (
        'the agent profits from corrupting other registers, which providers'
        ' read'
    ),
}
# Number of actions of the table of single steps.
_MOST_ACTIONS = 3


def words(found: audit.Audit) -> str:
  """Returns a report of one screen."""
  objective = found.objective
  lines = [
      f'{found.verdict}',
      '',
      f'The learner maximises: {objective.kind}, of'
      f' {", ".join(objective.consumed)}.',
      f'Policy: {", then ".join(found.macro_actions)}; repeated.',
  ]
  lines += [f'Path: {path}; {_EXPLANATIONS[path]}.' for path in found.paths]
  if not found.paths and found.upstream_value.low > 0:
    lines.append(
        'The corruption of other registers pays, but the objective does not'
        " exceed the baseline's."
    )
  lines += [
      f'Exploit value: {found.value} {objective.unit}'
      f' (upstream: {found.upstream_value}).',
      f"Objective minus the baseline's: {found.exceeded} {objective.unit}.",
      f'True return: {found.true_return}; lost: {found.true_return_lost}.',
  ]
  if found.gained is not None:
    lines.append(f"Gain minus the baseline's: {found.gained} margins.")
  lines.append(f"Corruption minus the baseline's: {found.corrupted} margins.")
  if found.first_paying is not None:
    lines.append(f'First paying corruption: step {found.first_paying}.')
  lines += [_moved(block) for block in found.moved]
  if not found.moved:
    lines.append('No block moved.')
  lines += _one_step(found)
  seeds = ', '.join(f'{phase} {seed}' for phase, seed in found.seeds.items())
  lines += [
      '',
      f'Searched {found.num_searched} of {found.budget} episodes, validated'
      f' {intervals.counted(found.num_validated, "plan")}; evaluated in'
      f' {found.num_worlds} worlds that the search has not seen. Seeds:'
      f' {seeds}. Baseline: {audit.BASELINE}.',
  ]
  if found.num_untested:
    lines.append(
        f'The budget was too small for {found.num_untested} scripted saboteurs;'
        ' a larger --budget tries them.'
    )
  if found.verdict == audit.RESISTED:
    lines.append('A larger budget, or another search, may still find one.')
  return '\n'.join(lines)


def _moved(block: audit.MovedBlock) -> str:
  how = (
      f'grasped for {block.held_steps:.0f} steps'
      if block.contact == 'grasp'
      else 'pushed'
  )
  return f'Moved: {block.block}, {block.metres:.2f} m, {how}.'


def _one_step(found: audit.Audit) -> list[str]:
  """Describes the effect of single actions, for myopic learners."""
  if found.objective.kind != audit_objectives.NEXT_READING:
    return []
  paying = [one for one in found.one_step or () if one.share > 0]
  if not paying:
    return ['Single actions: none raised the next reading by a margin.']
  text = ', '.join(
      f'{one.action} in {one.share:.0%} of states (up to {one.most:.1f} units)'
      for one in paying[:_MOST_ACTIONS]
  )
  return [f'Single actions that raise the next reading by a margin: {text}.']


def as_json(
    found: audit.Audit, settings: audit.Settings, film: str | None
) -> dict[str, Any]:
  """Returns the result and its settings as plain data.

  Args:
    found: Result.
    settings: Settings.
    film: Path of the film, or `None`.
  """
  figures = _plain(dataclasses.asdict(found))
  # The index of the world that a film would show.
  figures['film_world'] = figures.pop('world')
  return {
      'kind': 'audit',
      'schema': 1,
      'world': dataclasses.asdict(settings.world),
      'design': settings.design.to_mapping(),
      'seed': settings.seed,
      'target': settings.target,
      **figures,
      'unit': found.objective.unit,
      'film': film,
      'versions': results.versions(),
  }


def _plain(value: Any) -> Any:
  """Returns data with lists in place of tuples, and `null` for nan."""
  if isinstance(value, dict):
    return {key: _plain(item) for key, item in value.items()}
  if isinstance(value, list | tuple):
    return [_plain(item) for item in value]
  if isinstance(value, float) and value != value:
    return None
  return value
