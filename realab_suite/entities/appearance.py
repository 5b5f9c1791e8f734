"""Appearance of geoms: colours for cameras, class codes for the ray sense.

Each entity registers the classes of its geoms where it is defined:

  ROCK = appearance.register('rock', code=31, rgba=(0.5, 0.5, 0.5, 1.0))

and gives its geoms the attributes `geom_style(ROCK)`.
"""

from collections.abc import Sequence
import dataclasses
from typing import Any, final

from dm_control import mjcf
from dm_env import specs
import numpy as np

from realab_suite import errors

CAPACITY = 32
"""Number of class codes. All observation specs reserve them, so that a new
class changes no spec. Gymnasium's interface and the learners encode integers
with up to this number of values as classes."""

# Specs list the codes below this number in every world, so that one network
# fits all variations of a task, and other codes only in worlds that contain
# such objects. Networks have an input for each listed code: never change it.
_NUM_LISTED = 11

# Colours of the base block and the offset block of a register, by its role.
ROLE_COLOURS = {
    'feedback': ((0.10, 0.25, 0.70, 1.0), (0.35, 0.65, 1.00, 1.0)),
    'meter': ((0.45, 0.10, 0.55, 1.0), (0.80, 0.45, 0.95, 1.0)),
    'query': ((0.05, 0.45, 0.40, 1.0), (0.30, 0.85, 0.75, 1.0)),
    'signal': ((0.35, 0.35, 0.05, 1.0), (0.80, 0.80, 0.30, 1.0)),
    'memory': ((0.45, 0.20, 0.05, 1.0), (0.95, 0.60, 0.35, 1.0)),
}

_Colour = tuple[float, ...]


@final
@dataclasses.dataclass(frozen=True)
class _Class:
  """Class of objects.

  Attributes:
    code: Code that the ray sense reports.
    rgba: Colour of its geoms; `None` if each geom has a colour of its own.
  """

  code: int
  rgba: _Colour | None


_CLASSES: dict[str, _Class] = {}


def _checked_colour(where: str, rgba: Any) -> _Colour | None:
  """Returns a colour as a tuple.

  Raises:
    SpecError: If it is neither a colour nor `None`.
  """
  if rgba is None:
    return None
  try:
    colour = np.array(rgba, float)
  except (TypeError, ValueError):
    colour = np.zeros(0)
  if colour.shape != (4,) or not ((0.0 <= colour) & (colour <= 1.0)).all():
    raise errors.SpecError(
        f'{where}: rgba {rgba!r:.80}; must be four numbers from 0 to 1, or'
        ' None'
    )
  return tuple(colour.tolist())


def register(
    name: str, *, code: int, rgba: Sequence[float] | None = None
) -> str:
  """Registers a class of objects and returns its name.

  The code is part of observations, so it never changes. This package assigns
  codes in ascending order; other packages should begin with the largest.

  Args:
    name: Name of the class.
    code: Code that the ray sense reports, an integer from 0 to `CAPACITY - 1`.
    rgba: Colour of its geoms, `(4,)`, in [0, 1]; `None` if each geom has a
      colour of its own.

  Raises:
    SpecError: If the name or the code is that of another class, or if an
      argument has a value that is not allowed.
  """
  if not (isinstance(name, str) and name):
    raise errors.SpecError(
        f'class of objects: name {name!r:.80}; must be a non-empty string'
    )
  where = f'class of objects {name!r:.80}'
  if name in _CLASSES:
    if _CLASSES[name] == _Class(code, _checked_colour(where, rgba)):
      return name
    raise errors.SpecError(
        f'{where}: registered already, with code {_CLASSES[name].code}; must'
        ' be a new name'
    )
  owners = {one.code: owner for owner, one in _CLASSES.items()}
  free = [i for i in range(CAPACITY) if i not in owners]
  if type(code) is not int or code not in free:
    owner = owners.get(code) if type(code) is int else None
    taken = '' if owner is None else f' is that of {owner!r}'
    raise errors.SpecError(
        f'{where}: code {code!r:.80}{taken}; must be one of {free}'
    )
  _CLASSES[name] = _Class(code, _checked_colour(where, rgba))
  return name


_RED, _BLUE = (0.80, 0.25, 0.25, 1.0), (0.25, 0.40, 0.85, 1.0)
_PRESSED = (0.15, 0.75, 0.30, 1.0)

# The classes of this package. A module of entities is imported only in worlds
# that have them, and codes have to be taken before.
NOTHING = register('nothing', code=0)
"""Class that the ray sense reports for rays that hit nothing in their range."""

OTHER = register('other', code=1)
"""Class of geoms that have no other class."""

WALL = register('wall', code=2, rgba=(0.42, 0.47, 0.56, 1.0))
BARRIER = register('barrier', code=3, rgba=(0.55, 0.42, 0.60, 1.0))
DOOR = register('door', code=4, rgba=(0.45, 0.27, 0.12, 1.0))
PAD = register('pad', code=5, rgba=(0.95, 0.55, 0.10, 1.0))
PRESSED_PAD = register('pressed_pad', code=6, rgba=_PRESSED)
APPLE = register('apple', code=7, rgba=(0.85, 0.12, 0.12, 1.0))
LARGE_APPLE = register('large_apple', code=8, rgba=(0.98, 0.80, 0.10, 1.0))
BASE_BLOCK = register('base_block', code=9)
OFFSET_BLOCK = register('offset_block', code=10)
CRATE = register('crate', code=11, rgba=(0.72, 0.55, 0.33, 1.0))
GATE_PLATE = register('gate_plate', code=12, rgba=(0.9, 0.4, 0.1, 1.0))
MARK = register('mark', code=13, rgba=(0.25, 0.6, 0.45, 1.0))
RED_BALL = register('red_ball', code=14, rgba=_RED)
BLUE_BALL = register('blue_ball', code=15, rgba=_BLUE)
RED_CUBE = register('red_cube', code=16, rgba=_RED)
BLUE_CUBE = register('blue_cube', code=17, rgba=_BLUE)
SUPERVISOR = register('supervisor', code=18, rgba=(0.95, 0.85, 0.45, 1.0))
BUTTON = register('button', code=19, rgba=(0.95, 0.80, 0.20, 1.0))
OPERATOR = register('operator', code=20, rgba=(0.20, 0.30, 0.50, 1.0))


def code(name: str) -> int:
  """Returns the code that the ray sense reports for the class `name`.

  Raises:
    UnknownNameError: If no class of this name is registered.
  """
  return _find(name).code


def class_name(code: int) -> str:
  """Returns the name of the class with a code.

  Args:
    code: Code that the ray sense reports.

  Raises:
    UnknownNameError: If no class with this code is registered.
  """
  for name, object_class in _CLASSES.items():
    if object_class.code == code:
      return name
  raise errors.UnknownNameError(
      f'class of objects with code {code!r:.80}: unknown; known are {_known()}'
  )


def geom_style(name: str, rgba: Any = None) -> dict[str, Any]:
  """Returns geom attributes for a geom of the class `name`.

  The class code is stored as the geom's `user` number, so it can be read from
  any compiled model without its entities.

  Args:
    name: Name of a class.
    rgba: Colour; `None` for the colour of the class.

  Raises:
    SpecError: If there is no colour.
    UnknownNameError: If no class of this name is registered.
  """
  object_class = _find(name)
  colour = object_class.rgba if rgba is None else rgba
  if colour is None:
    raise errors.SpecError(
        f'class of objects {name!r:.80}: rgba None; must be a colour,'
        ' because the class has none'
    )
  return {'user': [object_class.code], 'rgba': colour}


def class_of_geoms(model: Any) -> np.ndarray:
  """Returns the class code of every geom of a compiled model, `(ngeom,)` int32.

  Geoms without a class, such as those of other packages, are `other`.
  """
  if not model.nuser_geom:
    return np.full(model.ngeom, code(OTHER), np.int32)
  codes = np.array(model.geom_user[:, 0], np.int32)
  codes[~np.isin(codes, _codes_of_geoms())] = code(OTHER)
  return codes


def listed_codes(root: mjcf.RootElement) -> tuple[int, ...]:
  """Returns the codes that the ray sense of a world can report, in order.

  Args:
    root: Model of the world, with all entities attached.
  """
  geoms = root.find_all('geom')
  # Default classes may set the numbers of geoms that have none.
  defaults = [
      default.geom
      for model in {geom.root for geom in geoms}
      for default in (model.default, *model.default.find_all('default'))
  ]
  codes = {
      int(geom.user[0]) for geom in (*geoms, *defaults) if geom.user is not None
  }
  return tuple(
      sorted(codes.intersection(_codes_of_geoms()) | set(range(_NUM_LISTED)))
  )


@final
class ClassArray(specs.BoundedArray):
  """Spec of class codes, which also lists the codes that a world can contain.

  The bounds are those of all codes that can be registered, so they are the same
  in every world. The list lets learners omit inputs that would always be 0.
  Like all subclasses of `BoundedArray`, it equals one with the same bounds.
  """

  __slots__ = ('_codes',)

  def __init__(
      self,
      shape: Sequence[int],
      codes: Sequence[int],
      name: str | None = None,
  ) -> None:
    """Initializes the spec.

    Args:
      shape: Shape of the array.
      codes: Codes of the classes that a world can contain.
      name: Name of the array.
    """
    super().__init__(shape, np.int32, 0, CAPACITY - 1, name)
    self._codes = tuple(codes)

  @property
  def codes(self) -> tuple[int, ...]:
    """Codes of the classes that a world can contain."""
    return self._codes

  def __repr__(self) -> str:
    return (
        f'ClassArray(shape={self.shape}, dtype={self.dtype!r},'
        f' name={self.name!r}, minimum={self.minimum}, maximum={self.maximum},'
        f' codes={self.codes})'
    )

  def __reduce__(self) -> Any:
    return ClassArray, (self.shape, self.codes, self.name)


def _find(name: str) -> _Class:
  if name not in _CLASSES:
    raise errors.UnknownNameError(
        f'class of objects {name!r:.80} is unknown; known are {_known()}'
    )
  return _CLASSES[name]


def _known() -> list[str]:
  return sorted(_CLASSES)


def _codes_of_geoms() -> list[int]:
  """Returns the registered codes that a geom can have."""
  # MuJoCo fills up missing `user` numbers with 0, the code of `nothing`.
  nothing = code(NOTHING)
  return [one.code for one in _CLASSES.values() if one.code != nothing]
