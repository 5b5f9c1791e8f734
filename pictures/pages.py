r"""Writes the sections of docs/worlds.md and docs/registers.md on each part.

  python -m pictures.pages

They follow a mark in each page; the text before it is written by hand. All of
them come from the code, and the figures of worlds from the file that
`benchmarks.suite_table` writes. `pictures.make` makes the pictures.
"""

import argparse
from collections.abc import Iterable, Sequence
import inspect
import json
import pathlib
import re
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import embedding
from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import registers
from realab_suite.entities import state
from realab_suite.feedback import mechanisms
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.verdicts import stakes
from realab_suite.tasks import base
from realab_suite.tasks import layouts
from realab_suite.tasks import registry

DOCS = pathlib.Path(__file__).parents[1] / 'docs'
FIGURES = DOCS / 'results' / 'worlds.json'
_MARK = (
    '<!-- The rest is made by `python -m pictures.pages`; do not edit it. -->'
)
# What is said of clean feedback, and the designs of which it is said.
ACCURATE, LACKS = 'accurate', 'lacks a place or what is measured'
DESIGNS = [name for name in specs.DESIGNS if name != 'none']
# What a register holds before something is done to it, and how much is done.
_RANGE, _VALUE = (0.0, 10.0), 5.0
_MOVED, _TURNED = 0.2, 0.5


def write() -> None:
  """Writes both pages."""
  for name, text in texts().items():
    (DOCS / name).write_text(text, encoding='utf-8')


def texts() -> dict[str, str]:
  """Returns the text of each page, by the name of its file."""
  return {
      name: f'{_by_hand(name)}{_MARK}\n\n{sections}'
      for name, sections in (
          ('worlds.md', worlds()),
          ('registers.md', register_kinds_section()),
      )
  }


def _by_hand(name: str) -> str:
  """Returns the text before the mark of a page."""
  text, mark, _ = (DOCS / name).read_text(encoding='utf-8').partition(_MARK)
  if not mark:
    raise ValueError(f'docs/{name}: must contain {_MARK!r}')
  return text


def worlds() -> str:
  """Returns the sections of the worlds of this package."""
  parts = [
      '**Accurate feedback.** A design is refused in a world where a meter may'
      ' measure more than the stated range of its register. Elsewhere, the'
      ' solver and random actions have played its secure twin, and clean values'
      ' were beyond the range of a register in at most'
      f' {100 * stakes.MOST_SATURATED:g} % of episodes (`python -m'
      ' benchmarks.suite_table --accuracy`). Worlds that are not named lack'
      ' a place, or what is measured.',
      accuracy_table(),
      *map(_domain, suite.TASKS_BY_DOMAIN),
  ]
  return '\n\n'.join(parts) + '\n'


def accuracy_table() -> str:
  """Returns the table of designs by worlds: whether clean feedback is right."""
  columns: dict[str, dict[str, list[str]]] = {
      design: {ACCURATE: [], LACKS: []} for design in DESIGNS
  }
  for domain in suite.TASKS_BY_DOMAIN:
    for design, by_text in accuracies(domain).items():
      for text, tasks in by_text.items():
        names = [f'{domain}.{task}' for task in tasks]
        columns[design].setdefault(text, []).extend(
            [domain] if len(by_text) == 1 else names
        )
  rows: dict[tuple[str, str], list[str]] = {}
  for design, column in columns.items():
    accurate = column.pop(ACCURATE)
    del column[LACKS]
    refused = '; '.join(f'{_listed(n)}: {text}' for text, n in column.items())
    where = _listed(accurate)
    if accurate == [*suite.TASKS_BY_DOMAIN]:
      where = 'all'
    elif accurate == [design]:
      where = 'their own'
    cells = where, refused or '-'
    rows.setdefault(cells, []).append(design)
  return table(
      ('designs', ACCURATE, 'refused, or not accurate'),
      [(_listed(designs), *cells) for cells, designs in rows.items()],
  )


def accuracies(domain: str) -> dict[str, dict[str, list[str]]]:
  """Returns tasks by what is said on their clean feedback, by design."""
  at_load: dict[Any, str] = {}
  said: dict[str, dict[str, list[str]]] = {
      design: {} for design in suite.designs_for(domain) if design != 'none'
  }
  for task in suite.TASKS_BY_DOMAIN[domain]:
    row = figures().get(f'{domain}.{task}', {})
    world = registry.find(domain, task)()
    for design, by_text in said.items():
      # Tasks of a domain with equal ranges refuse the same designs.
      key = design, *sorted(world.measured_ranges.items())
      if key not in at_load:
        at_load[key] = _at_load(world, design)
      text = at_load[key]
      if text == ACCURATE:
        measured = row.get(f'saturated, {design}', '0 of 0')
        saturated, episodes = map(int, measured.split(' of '))
        if not episodes:
          text = 'not yet played'
        elif saturated > stakes.MOST_SATURATED * episodes:
          text = f'saturated in {measured} episodes'
      by_text.setdefault(text, []).append(task)
  return said


def _at_load(world: base.Task, design: str) -> str:
  """Returns whether a world refuses a design."""
  spec = specs.load(design).in_world(world.SOLVER)
  spec = spec.fitted(world.measured_ranges)
  mechanism = mechanisms.FeedbackMechanism(spec)
  try:
    mechanism.attach_to(world.root_entity)
  except errors.SpecError as error:
    if 'has no place' in str(error):
      return LACKS
    raise
  try:
    embedding.connect_meters(world, mechanism, {})
  except errors.SpecError as error:
    text = str(error)
    if needed := re.search(r"contain (\[.*\]), the range of '(\w+)'", text):
      return f'{needed[2]} in {needed[1]}'
    if re.search('cannot be measured|does not offer', text):
      return LACKS
    raise
  finally:
    mechanism.detach_from_root()
  return ACCURATE


def _domain(domain: str) -> str:
  tasks = suite.TASKS_BY_DOMAIN[domain]
  first = tasks[0]
  task = registry.find(domain, first)()
  row = figures().get(f'{domain}.{first}', {})
  solver = 'none' if task.SOLVER is None else f'`{task.SOLVER}`'
  if task.SOLVER is not None:
    if senses := _listed(policies.make(task.SOLVER).privileged_senses):
      solver += f' (senses {senses})'
  if earned := row.get('solver'):
    solver += f'; earns {earned}'
  speed = ''
  if {'single', 'batch'} <= row.keys():
    speed = f'{row["single"]}; {row["batch"]} in a batch'
  facts = {
      'Tasks': ', '.join(
          f'[`{name}`](images/worlds/{domain}.{name}.png)' for name in tasks
      ),
      'Design': _own_design(domain),
      'Solver': solver,
      'Facts': _listed(task.facts),
      'Measurements': _listed(task.measurements),
      'Parts': _listed(task.measurables),
      'Places': _listed(
          name
          for name in task.root_entity.places
          if name not in layouts.Layout().stations
      ),
      'Steps/s': speed,
  }
  picture = (
      f'![{domain}.{first} from above](images/worlds/{domain}.{first}.png)'
  )
  lines = [f'- {name}: {text}' for name, text in facts.items() if text]
  text = _paragraphs(type(task))
  return '\n\n'.join([f'### {domain}', picture, *text, '\n'.join(lines)])


def _own_design(domain: str) -> str:
  """Returns the design of a world's own, and what attacks it in `own`."""
  run = experiment_specs.load('own').runs[domain]
  return f'`{run.design}` ({_listed(run.baselines)})'


def figures() -> dict[str, dict[str, str]]:
  """Returns the measured figures of the worlds, by name."""
  if not FIGURES.exists():
    return {}
  rows: dict[str, dict[str, str]] = json.loads(FIGURES.read_text())
  return rows


def _paragraphs(kind: type[base.Task]) -> list[str]:
  """Returns the docstring of the module of a world."""
  paragraphs = _of_docstring(inspect.getmodule(kind))
  for word in ('Intended behaviour:', 'Exploit:'):
    paragraphs = [text.replace(word, f'**{word}**', 1) for text in paragraphs]
  return paragraphs


def _of_docstring(thing: Any) -> list[str]:
  """Returns the paragraphs of a docstring, each in one line, except lists."""
  text = inspect.getdoc(thing) or ''
  return [
      one if one.startswith('*') else ' '.join(one.split())
      for one in text.split('\n\n')
  ]


def _at(place: Sequence[float]) -> str:
  return f'({place[0]:g}, {place[1]:g})'


def _listed(names: Iterable[str]) -> str:
  return ', '.join(f'`{name}`' for name in names)


def register_kinds_section() -> str:
  """Returns the sections of the kinds of registers of this package."""
  fields = specs.RegisterSpec.model_fields
  common = [
      (
          f'`{name}`',
          'required'
          if fields[name].is_required()
          else f'`{fields[name].default}`',
          about,
      )
      for name, about in _attributes(registers.Arguments)
  ]
  parts = [
      '## Options of every kind',
      table(('option', 'default', 'meaning'), common),
      '## Kinds',
      f'A register of each kind, with the range {_RANGE[0]:g} to {_RANGE[1]:g}'
      f' and the default scale, contains {_VALUE:g}. A block is moved by'
      f" {_MOVED:g} m along the register's axis, across it or upwards, or"
      f' turned by {_TURNED:g} rad. The tables have the reading after that, and'
      ' the reading after the next write, which repairs temporary corruption'
      ' only. A dash means that nothing changes. With several ports, there is a'
      ' number for each.',
  ]
  for name in register_kinds.REGISTER_KINDS:
    # What a kind shares with an earlier one is not repeated.
    parts += [text for text in _kind(name) if text not in parts]
  return '\n\n'.join(parts) + '\n'


def _kind(name: str) -> list[str]:
  """Returns the paragraphs of a kind."""
  kind = register_kinds.REGISTER_KINDS.get(name)
  register, physics = _built(kind)
  ports = _listed(f'<register>_{port}' for port in kind.PORTS)
  shared = inspect.signature(registers.Register._build).parameters
  own = [
      (f'`{option}`', f'`{one.default}`')
      for option, one in inspect.signature(kind._build).parameters.items()
      if option not in shared and one.kind is not inspect.Parameter.VAR_KEYWORD
  ]
  text = _of_docstring(kind)
  if len(text) == 1 and kind.__mro__[1] is not registers.Register:
    # The first paragraph says what is different, and the base class the rest.
    text += _of_docstring(kind.__mro__[1])[1:]
  text = [one for one in text if not one.startswith('A subclass')]
  blocks = [
      (
          f'`{block.geom.name}`',
          'none' if block.direction is None else _at(block.direction),
          *(
              _tried(register, physics, block, *deed)
              for deed in _DEEDS.values()
          ),
      )
      for block in register.blocks
  ]
  header = ('block', 'direction that raises the reading', *_DEEDS)
  parts = [
      f'### {name}',
      f'![A register of kind {name}](images/registers/{name}.png)'
      if blocks
      else '',
      *text,
      f'Ports: {ports}.' if ports else '',
      table(('option of its own', 'default'), own) if own else '',
      table(header, blocks) if blocks else '',
  ]
  return [part for part in parts if part]


# Displacement in m, and turn in rad.
_DEEDS: dict[str, tuple[tuple[float, float, float], float]] = {
    'along': ((_MOVED, 0.0, 0.0), 0.0),
    'across': ((0.0, _MOVED, 0.0), 0.0),
    'up': ((0.0, 0.0, _MOVED), 0.0),
    'turned': ((0.0, 0.0, 0.0), _TURNED),
}


def _built(
    kind: type[registers.Register],
) -> tuple[registers.Register, single_physics.ThinPhysics]:
  """Returns a register in an empty room."""
  arena = arenas.OpenRoom()
  register = kind('shown', value_range=_RANGE)
  register.attach_to(arena, (0.0, 0.0))
  state.make_room(arena.mjcf_model)
  physics = single_physics.ThinPhysics.from_mjcf_model(arena.mjcf_model)
  return register, physics


def _tried(
    register: registers.Register,
    physics: Any,
    block: Any,
    displacement: tuple[float, float, float],
    turn: float,
) -> str:
  """Returns the readings after something was done, and after a write."""
  value = np.full(len(register.PORTS) or (), _VALUE)
  with physics.reset_context():
    register.initialize_episode(physics, np.random.RandomState(0))
  register.write(physics, value)
  physics.refresh()
  place = np.array(block.position(physics)) + displacement
  block.put(physics, place, block.heading(physics) + turn)
  physics.refresh()
  disturbed = _numbers(register.read(physics))
  register.write(physics, value)
  physics.refresh()
  repaired = _numbers(register.read(physics))
  undisturbed = _numbers(value)
  is_same = disturbed == repaired == undisturbed
  return '-' if is_same else f'{disturbed}; {repaired}'


def _attributes(kind: type[Any]) -> list[tuple[str, str]]:
  """Returns the name and the description of each attribute of a class."""
  text = (inspect.getdoc(kind) or '').partition('Attributes:\n')[2]
  found = re.findall(r'^  (\w+): (.*(?:\n    .*)*)', text, re.MULTILINE)
  return [(name, ' '.join(about.split())) for name, about in found]


def _numbers(values: np.ndarray) -> str:
  rounded = np.round(np.atleast_1d(values), 3) + 0.0
  return ', '.join(f'{number:g}' for number in rounded)


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
  """Returns a table in Markdown."""
  lines = [header, ['---'] * len(header), *rows]
  return '\n'.join(f'| {" | ".join(map(str, line))} |' for line in lines)


if __name__ == '__main__':
  argparse.ArgumentParser(
      description='Writes the sections of docs/worlds.md and docs/registers.md'
      ' about the worlds and kinds of registers of this package.'
  ).parse_args()
  write()
