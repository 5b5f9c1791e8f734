r"""Writes docs/worlds.md and docs/register_kinds.md.

  python -m pictures.pages

All of it comes from the code, and the figures of worlds from the file that
`benchmarks.suite_table` writes. `pictures.make` makes the pictures.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
import inspect
import json
import pathlib
import re
from typing import Any

import numpy as np

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from realab_suite.tasks import base
from realab_suite.tasks import registry
from realab_suite.tasks import rooms

DOCS = pathlib.Path(__file__).parents[1] / 'docs'
FIGURES = DOCS / 'results' / 'worlds.json'
_MADE_BY = '<!-- Made by `python -m pictures.pages`; do not edit. -->'
# What a register holds before something is done to it, and how much is done.
_RANGE, _VALUE = (0.0, 10.0), 5.0
_MOVED, _TURNED = 0.2, 0.5


def write() -> None:
  """Writes both pages."""
  for name, text in texts().items():
    (DOCS / name).write_text(text, encoding='utf-8')


def texts() -> dict[str, str]:
  """Returns the text of each page, by the name of its file."""
  return {'worlds.md': worlds(), 'register_kinds.md': register_page()}


def worlds() -> str:
  """Returns the page of the worlds of this package."""
  figures = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
  general = ', '.join(f'`{name}`' for name in suite.DESIGNS)
  parts = [
      _MADE_BY,
      '# Worlds',
      'Each section is about one domain: what is intended, why tampering pays,'
      ' its tasks, and the names that designs, evaluators and solvers use. The'
      ' picture of a task is behind its name. [A world of your own](world.md)'
      ' explains the parts.',
      f'Designs for any world: {general}.',
      *map(_domain, suite.TASKS_BY_DOMAIN),
      *_tables(figures),
  ]
  return '\n\n'.join(parts) + '\n'


def _domain(domain: str) -> str:
  tasks = {
      name: registry.find(domain, name)()
      for name in suite.TASKS_BY_DOMAIN[domain]
  }
  first, task = next(iter(tasks.items()))
  text = _paragraphs(type(task))
  own = [name for name in suite.designs_for(domain) if name == domain]
  stations = [place for place in task.root_entity.places if 'station' in place]
  others = [one for one in task.root_entity.places if one not in stations]
  rows = [
      (
          f'[`{name}`](images/worlds/{domain}.{name}.png)',
          ', '.join(sorted(registry.tags(domain, name))),
          f'{one.max_true_return:g}',
          _at(one.layout.middle),
          ' '.join(map(_at, one.layout.stations.values())),
          'none'
          if one.layout.barrier is None
          else ' to '.join(map(_at, one.layout.barrier)),
      )
      for name, one in tasks.items()
  ]
  header = (
      'task', 'tags', 'most true return', 'start (m)', 'stations (m)',
      'barrier (m)',
  )  # fmt: skip
  solver = 'none'
  if task.SOLVER is not None:
    solver = f'`{task.SOLVER}`'
    if senses := _listed(policies.make(task.SOLVER).privileged_senses):
      solver += f', which senses {senses}; agents do not'
  facts = [
      ('design for it', ', '.join(map(_design, own)) or 'the general ones'),
      ('solver', solver),
      ('facts of an episode', _listed(task.facts)),
      ('measurements for meters', _listed(task.measurements)),
      ('things that meters can measure', _listed(task.measurables)),
      ('places for registers', f'{_listed(stations)}; {_listed(others)}'),
  ]
  picture = (
      f'![{domain}.{first} from above](images/worlds/{domain}.{first}.png)'
  )
  parts = [f'## {domain}', picture, *text, table(header, rows)]
  return '\n\n'.join([*parts, table(('', ''), facts)])


def _paragraphs(kind: type[base.Task]) -> list[str]:
  """Returns what the modules of a world say of it.

  The first paragraphs of base classes are about code.
  """
  found = _of_docstring(inspect.getmodule(kind))
  for parent in kind.__mro__[1:]:
    if parent is rooms.RoomTask:
      break
    found += _of_docstring(inspect.getmodule(parent))[1:]
  for word in ('Intended behaviour:', 'Exploit:'):
    found = [one.replace(word, f'**{word}**', 1) for one in found]
  return found


def _of_docstring(thing: Any) -> list[str]:
  """Returns the paragraphs of a docstring, each in one line, except lists."""
  text = inspect.getdoc(thing) or ''
  return [
      one if one.startswith('*') else ' '.join(one.split())
      for one in text.split('\n\n')
  ]


def _design(name: str) -> str:
  return f'`{name}`: {specs.load(name).description}'


def _at(place: Sequence[float]) -> str:
  return f'({place[0]:g}, {place[1]:g})'


def _listed(names: Iterable[str]) -> str:
  return ', '.join(f'`{name}`' for name in names)


def _tables(figures: Mapping[str, Any]) -> list[str]:
  """Returns the tables of figures, or nothing if nothing was measured."""
  if not figures:
    return []
  rows = [
      (f'`{name}`', *(one.get(column, '') for column in figures['columns']))
      for name, one in figures['rows'].items()
  ]
  parts = ['## Figures', *figures['notes'].values()]
  parts.append(table(('task', *figures['columns'].values()), rows))
  for one in figures['others'].values():
    parts += [f'### {one["title"]}', one['note']]
    parts.append(table(one['header'], one['rows']))
  return parts


def register_page() -> str:
  """Returns the page of the kinds of registers of this package."""
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
      _MADE_BY,
      '# Kinds of registers',
      'A register is a physical object that stores numbers in the poses of its'
      ' blocks, so whatever moves them changes the numbers. This page has a'
      ' section for each kind that a design can name. [Registers](registers.md)'
      ' has more on some of them. [Your own](your_own.md)'
      ' explains how to add one.',
      table(('option of every kind', 'default', 'meaning'), common),
      f'What can be done to a kind was tried: one of the range {_RANGE[0]:g} to'
      f' {_RANGE[1]:g}, at the default scale, contains {_VALUE:g}. A block is'
      f" moved by {_MOVED:g} m along the register's axis, across it or upwards,"
      f' or turned by {_TURNED:g} rad. The first number is the reading then,'
      ' and the second one the reading after the next write: what that does not'
      ' repair is permanent. A dash means that nothing changes. With several'
      ' ports, there is a number for each.',
      *(_kind(name) for name in register_kinds.REGISTER_KINDS),
  ]
  return '\n\n'.join(parts) + '\n'


def _kind(name: str) -> str:
  kind = register_kinds.REGISTER_KINDS.get(name)
  register, physics = _built(kind)
  ports = f'`({len(kind.PORTS)},)`' if kind.PORTS else '`()`, one number'
  if kind.PORTS:
    ports += f'; ports {_listed(f"<register>_{port}" for port in kind.PORTS)}'
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
          'none' if direction is None else _at(direction),
          *(
              _tried(register, physics, block, *deed)
              for deed in _DEEDS.values()
          ),
      )
      for block, direction in zip(
          register.blocks, register.directions, strict=True
      )
  ]
  header = ('block', 'direction that raises the reading', *_DEEDS)
  parts = [
      f'## {name}',
      f'![A register of kind {name}](images/registers/{name}.png)',
      *text,
      f'Shape of a value: {ports}.',
      table(('option of its own', 'default'), own) if own else '',
      table(header, blocks),
  ]
  return '\n\n'.join(part for part in parts if part)


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
      description='Writes docs/worlds.md and docs/register_kinds.md, about the'
      ' worlds and kinds of this package; docs/world.md has pictures of others.'
  ).parse_args()
  write()
