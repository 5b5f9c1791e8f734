"""Extension of Sphinx: pages of worlds, designs and modules from the code.

The tables of a page come from the world or the design itself, so they belong to
the code beside them.
"""

import ast
from collections.abc import Iterable, Mapping, Sequence
import contextlib
import importlib.util
import inspect
import pathlib
import pkgutil
import re
from typing import Any

from dm_control import composer
import numpy as np

import realab_suite
from realab_suite import suite
from realab_suite.feedback import specs
from realab_suite.policies import action_sets

_FOLDER = pathlib.Path('build', 'catalogue')
# Relative to the folders `worlds` and `designs`.
_ROOT = '../../..'
# Packages without an interface for users.
_INTERNAL = ('launchers', 'reports')
_READERS = {
    'feedback': ('its provider', 'the agent, and providers that name it'),
    'meter': ('its meter', 'providers that name it'),
    'query': ('the agent, by its query', 'providers that name it'),
    'memory': ('its provider', 'providers that name it'),
    'signal': ('its provider', 'the agent, and providers that name it'),
}


def setup(app: Any) -> dict[str, bool]:
  """Connects the extension."""
  app.connect('builder-inited', _write_all)
  app.connect('source-read', _show_readme)
  app.connect('autodoc-process-signature', _show_build)
  # Before napoleon, which has the usual priority of 500.
  app.connect('autodoc-process-docstring', _add_arguments, priority=300)
  app.connect('autodoc-process-docstring', _mark_code, priority=400)
  app.connect('autodoc-process-docstring', _mark_bars, priority=400)
  return {'parallel_read_safe': True}


def _write_all(app: Any) -> None:
  packages = _packages(_modules())
  pages = {
      'modules.txt': _index(packages),
      **{
          f'api/{name}.rst': _package(name, modules)
          for name, modules in packages.items()
      },
      **{f'designs/{name}.md': _design(name) for name in suite.DESIGNS},
  }
  for domain, task in suite.ALL_TASKS:
    pages[f'worlds/{domain}.{task}.md'] = _world(domain, task)
  root = pathlib.Path(app.srcdir) / _FOLDER
  # Of modules, designs and worlds that no longer exist.
  for path in root.glob('*/*'):
    if str(path.relative_to(root)) not in pages:
      path.unlink()
  for name, text in pages.items():
    _write(root / name, text)


def _show_readme(app: Any, name: str, source: list[str]) -> None:
  """Makes README the landing page, with links from there."""
  if name == 'README':  # Other pages lead to it, and the landing page shows it.
    source[0] = f'---\norphan: true\n---\n{source[0]}'
  if name == app.config.root_doc:
    root = '../' * name.count('/')
    text = pathlib.Path(app.srcdir, 'README.md').read_text(encoding='utf-8')
    # Links to other sites have a colon, those within the page begin with #.
    links = re.sub(r'\]\((?=[^:#)]+[#)])', f']({root}', text)
    source[0] = f'{links}\n{source[0]}'


def _show_build(
    app: Any, what: str, name: str, obj: Any, options: Any, *signature: Any
) -> tuple[str, str] | None:
  """Shows the arguments of an entity of Composer, not `*args, **kwargs`."""
  del app, what, name, options, signature
  if not (inspect.isclass(obj) and issubclass(obj, composer.Entity)):
    return None
  shown = inspect.signature(obj._build)
  parameters = list(shown.parameters.values())[1:]
  return str(shown.replace(parameters=parameters, return_annotation=())), ''


def _add_arguments(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
  """Adds the description of the arguments of a class to its docstring."""
  del app, what, name, options
  if not inspect.isclass(obj):
    return
  own = vars(obj)
  text = inspect.getdoc(own.get('_build') or own.get('__init__'))
  # Classes that generate their constructors describe attributes.
  if text and 'Args:' in text:
    lines += ['', *text.splitlines(), '']


def _mark_code(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
  """Makes an indented block a literal block, as in Markdown."""
  del app, what, name, obj, options
  for i in reversed(range(len(lines) - 2)):
    line, between, block = lines[i : i + 3]
    indent = len(line) - len(line.lstrip())
    if not line.strip() or between.strip() or not block.strip():
      continue
    if block.startswith(' ' * (indent + 2)):
      if line.endswith(':'):
        lines[i] = f'{line}:'
      else:
        lines[i + 1 : i + 2] = ['', f'{" " * indent}::', '']


def _mark_bars(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
  """Escapes the bars of absolute values, which are no substitutions."""
  del app, what, name, obj, options
  for i, line in enumerate(lines):
    lines[i] = re.sub(r'\|(?=\S)|(?<=\S)\|', r'\|', line)


def _write(path: pathlib.Path, text: str) -> None:
  """Writes a page if it has changed, so that Sphinx builds it again."""
  path.parent.mkdir(parents=True, exist_ok=True)
  if not path.exists() or path.read_text(encoding='utf-8') != text:
    path.write_text(text, encoding='utf-8')


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
  lines = [header, ['---'] * len(header), *rows]
  return '\n'.join(f'| {" | ".join(map(str, line))} |' for line in lines)


def _world(domain: str, task: str) -> str:
  env = suite.load(domain, task, {'random': 0}, design=None)
  with contextlib.closing(env):
    kind = type(env.task)
    layout = env.task.layout
    summary = inspect.getdoc(inspect.getmodule(kind)) or ''
    observations = [
        (
            f'`{key}`',
            ' x '.join(map(str, spec.shape)) or 'one number',
            spec.dtype,
            _range(spec),
            'the agent; a provider that requires this sense',
        )
        for key, spec in env.observation_spec().items()
    ]
    spec = env.action_spec()
    actions = [
        (i, f'`{name}`', f'{low:g} to {high:g}')
        for i, (name, low, high) in enumerate(
            zip(spec.name.split('\t'), spec.minimum, spec.maximum, strict=True)
        )
    ]
    places = [
        (f'`{name}`', f'({place.position[0]:g}, {place.position[1]:g})')
        for name, place in env.task.root_entity.places.items()
    ]
    measurements = ', '.join(f'`{name}`' for name in env.task.measurements)
    greatest = env.task.max_true_return
  x, y = layout.middle
  barrier = ''
  if layout.barrier is not None:
    ends = ' to '.join(f'({x:g}, {y:g})' for x, y in layout.barrier)
    barrier = f' A barrier leads from {ends}.'
  if layout.is_impossible:
    barrier += ' No true reward can be earned.'
  design = suite.designs_for(domain)[-1]
  if design != domain:
    design = 'instantaneous_reward'
  return f"""# {domain}.{task}

{summary}

![The room from above]({_ROOT}/docs/images/worlds/{domain}.{task}.png)

```python
env = suite.load('{domain}', '{task}', design='{design}')
```

The avatar starts near ({x:g}, {y:g}), in m, and the largest possible
true return is {greatest:g}.{barrier}

## Observations

{_table(['key', 'shape', 'type', 'range', 'who may read it'], observations)}

[Senses](../../../docs/registers.md#senses) has the content and unit of each. A
design adds the readings of its feedback registers, in units of each register.

## Actions

{_table(['element', 'name', 'range'], actions)}

Designs with an action set have a list of discrete actions instead.

## Places for registers

{_table(['name', 'position (m)'], places)}

## Measurements

Meters, and nothing else, may read the true state: {measurements}.
[Designs of your own](../../../docs/your_own.md) explains measurements with
options.
"""


def _range(spec: Any) -> str:
  if not hasattr(spec, 'minimum'):
    return 'unbounded'
  return f'{np.min(spec.minimum):g} to {np.max(spec.maximum):g}'


def _listed(names: Iterable[str]) -> str:
  return ', '.join(f'`{name}`' for name in names) or '-'


def _design(name: str) -> str:
  design = specs.load(name)
  registers = [
      (
          f'`{key}`',
          one.role,
          one.kind,
          f'`{one.place}`',
          f'{one.range[0]:g} to {one.range[1]:g}',
          f'{one.scale:g}',
          *_READERS[one.role],
      )
      for key, one in design.registers.items()
  ]
  parts = [f'# {name}', design.description]
  if registers:
    header = ['register', 'role', 'kind', 'place', 'range (units)',
              'm per unit', 'written by', 'read by']  # fmt: skip
    parts += ['## Registers', _table(header, registers)]
  if design.providers:
    parts.append('## Providers')
    rows = [
        (f'`{one.kind}`', _listed(one.reads), _listed(one.writes))
        for one in design.providers
    ]
    parts.append(_table(['kind', 'reads', 'writes'], rows))
  if design.action_set is not None:
    chosen = action_sets.get(design.action_set.name, design.action_set.version)
    rows = [
        (i, action, ', '.join(f'{k} {v:g}' for k, v in elements.items()) or '-')
        for i, (action, elements) in enumerate(chosen.actions)
    ]
    parts += [
        f'## Actions: {chosen.name}, version {chosen.version}',
        _table(['index', 'action', 'controls'], rows),
    ]
  file = pathlib.Path(suite.__file__).parents[1] / 'configs' / 'designs'
  whole = (file / f'{name}.yaml').read_text(encoding='utf-8')
  parts += ['## File', f'```yaml\n{whole}```']
  return '\n\n'.join(parts) + '\n'


def _modules() -> list[str]:
  found = pkgutil.walk_packages(realab_suite.__path__, 'realab_suite.')
  names = [
      one.name
      for one in found
      if not any(
          part.startswith('_') or part in _INTERNAL
          for part in one.name.split('.')
      )
  ]
  return ['realab_suite', *names]


def _packages(names: Iterable[str]) -> dict[str, list[str]]:
  """Returns the modules of each package, and modules in none by themselves.

  A page has a package: the navigation, which is on all pages, takes most of the
  time of a build, and grows with their number.
  """
  packages: dict[str, list[str]] = {}
  for name in names:
    packages.setdefault('.'.join(name.split('.')[:2]), []).append(name)
  return packages


def _index(packages: Mapping[str, Sequence[str]]) -> str:
  """Returns tables of all modules, by package."""
  alone = [name for name, modules in packages.items() if len(modules) == 1]
  parts = [_modules_table(alone)]
  for name, modules in packages.items():
    if len(modules) > 1:
      parts += [f'## {name}', _modules_table(modules)]
  return '\n\n'.join(parts) + '\n'


def _modules_table(names: Sequence[str]) -> str:
  rows = []
  for name in names:
    # Not imported: some modules need packages of extras.
    found = importlib.util.find_spec(name)
    source = pathlib.Path(found.origin).read_text(encoding='utf-8')
    text = ast.get_docstring(ast.parse(source)) or ''
    summary = ' '.join(text.split('\n\n')[0].split())
    rows.append((f'[{name}](#{name})', summary))
  return _table(['module', 'what it holds'], rows)


def _package(name: str, modules: Iterable[str]) -> str:
  parts = [_heading(name, '=')]
  for module in modules:
    if module != name:
      parts.append(_heading(module, '-'))
    parts.append(f'.. automodule:: {module}')
  return '\n\n'.join(parts) + '\n'


def _heading(name: str, line: str) -> str:
  title = name.replace('_', '\\_')
  return f'{title}\n{line * len(title)}'
