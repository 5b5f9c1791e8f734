"""Ranges and scales that registers need in worlds, where a design states none.

A world with losses, or with a larger score, needs other registers than those
that a design usually has.
"""

from collections.abc import Iterable, Iterator, Mapping
import contextlib
import math
from typing import Any, Final

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.feedback import measurements

USUAL: Final = 'usual'
"""Key of a range that gives way to what a world declares."""

FINE: Final = 1e-3
"""Smallest scale, in m per unit, that a world gets without a warning."""

_Range = measurements.Range

# Largest distance of a block from its place for 0 at the lower end, and between
# both ends, in m (rad for an orientation). The places of rooms have this much.
_BELOW, _IN_ALL = 0.4, 2.0


def read_open(data: Any) -> tuple[Any, set[str]]:
  """Returns the data of a register with plain values, and what was open in it.

  Args:
    data: Data whose range may be `{usual: [low, high]}`, and its scale
      `{usual: scale}`.

  Raises:
    ValueError: If one of them is another mapping.
  """
  is_open = set()
  for name, form in (('range', '[low, high]'), ('scale', 'scale')):
    given = data.get(name) if isinstance(data, Mapping) else None
    if not isinstance(given, Mapping):
      continue
    usual: Any = given.get(USUAL)
    is_list = loading.is_list(usual)
    # An override of one end states both.
    ends = {'0', '1'} if is_list else set()
    is_form = usual is not None and given.keys() <= {USUAL, *ends}
    if not is_form or is_list != (name == 'range'):
      raise ValueError(
          f'{name}: {messages.quote(given)}; must be {form} or'
          f' {{{USUAL}: {form}}}'
      )
    if is_list:
      usual = [given.get(str(i), end) for i, end in enumerate(usual)]
    if len(given) == 1:
      is_open.add(name)
    data = {**data, name: usual}
  return data, is_open


def holds(available: _Range, needed: _Range) -> bool:
  """Returns True if a range contains another one.

  Args:
    available: Lowest and highest value of a register.
    needed: Lowest and highest value that it is to store.
  """
  # Sums of 0.1 may differ from what anybody would write.
  low, high = round(needed[0], 9), round(needed[1], 9)
  return available[0] <= low and high <= available[1]


def changes(
    design: Any, worlds: Iterable[Mapping[str, _Range]]
) -> dict[str, tuple[_Range, float]]:
  """Returns the range and the scale of each register that needs others.

  A meter register needs what its meters may measure. A register that providers
  compute from one that has changed needs what they may write.

  Args:
    design: A `specs.DesignSpec`.
    worlds: Ranges of what each world measures, by name.
  """
  changed: dict[str, tuple[_Range, float]] = {}
  needs: dict[str, list[_Range]] = {}
  for world in worlds:
    for name, needed in _measured(design, world):
      needs.setdefault(name, []).append(needed)
  _change(design, needs, changed)
  ranges = {name: spec.range for name, spec in design.ports.items()}
  for _ in design.providers:  # Some read what later ones write.
    for name, change in changed.items():
      ranges |= dict.fromkeys(design.ports_by_register[name], change[0])
    written: dict[str, list[_Range]] = {}
    for provider in design.providers:
      if not changed.keys().isdisjoint(map(design.register_of, provider.reads)):
        for name, ends in provider.write_ranges(ranges).items():
          written.setdefault(design.register_of(name), []).append(ends)
    _change(design, written, changed)
  return changed


def _change(
    design: Any,
    needs: Mapping[str, list[_Range]],
    changed: dict[str, tuple[_Range, float]],
) -> None:
  """Adds the registers that do not state a range, and need another one."""
  for name, needed in needs.items():
    spec = design.registers[name]
    if 'range' in spec.model_fields_set or all(
        holds(spec.range, one) for one in needed
    ):
      continue
    ends = [0.0, spec.constant_initial, *(end for one in needed for end in one)]
    low, high = round(float(min(ends)), 9), round(float(max(ends)), 9)
    if 'scale' in spec.model_fields_set:
      changed[name] = (low, high), spec.scale
      continue
    scale = min(_BELOW / max(-low, 1e-9), _IN_ALL / (high - low))
    if 0 < scale < spec.scale:
      unit = 10.0 ** (math.floor(math.log10(scale)) - 1)
      scale = float(f'{math.floor(scale / unit) * unit:.1e}')
    changed[name] = (low, high), min(scale, spec.scale)


def _measured(
    design: Any, ranges: Mapping[str, _Range]
) -> Iterator[tuple[str, _Range]]:
  """Yields the names of registers with what they get in a world, if known."""
  for i, meter in enumerate(design.meters):
    needed = None
    if isinstance(meter.measures, str):
      needed = ranges.get(meter.measures)
    else:
      world = measurements.World(
          messages.Location(f'design {design.name!r}', ('meters', i)),
          {},
          {},
          measurements.AskedRegisters({}),
          ranges,
      )
      # What depends on parts of the world is checked when it is connected.
      with contextlib.suppress(errors.RealabError):
        needed = meter.measures.range_in(world)
    if needed is not None:
      yield design.register_of(meter.writes), needed
  for register, ports in design.ports_by_register.items():
    initial = design.registers[register].initial
    if isinstance(initial, str):
      suffixes = [port.removeprefix(register) for port in ports]
      for name in (initial, *(f'{initial}{suffix}' for suffix in suffixes)):
        if name in ranges:
          yield register, ranges[name]
