r"""Makes the pictures of the README and the docs.

  python -m realab_suite.launchers.sweep --experiment=quick \
    --output=results/quick
  python -m pictures.make --input=results/quick --output=docs/images

Without `--input`, the animated picture is left out, because it shows trained
agents. The same versions and results give the same pictures.
"""

import pathlib

from realab_suite import errors
from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.INPUT, flags.OUTPUT)


def main() -> None:
  """Writes the pictures; existing ones are replaced."""
  folder = pathlib.Path(flags.required(flags.OUTPUT))
  problem = (
      requirements.missing('matplotlib', 'PIL') or renderers.choose_renderer()
  )
  if problem is not None:
    raise errors.ResultsError(f'cannot make pictures: {problem}')
  # These import dm_control, so a renderer has to be chosen first.
  from pictures import carrying
  from pictures import first_person
  from pictures import registers
  from pictures import tampering
  from pictures import worlds

  folder.mkdir(parents=True, exist_ok=True)
  first_person.draw(folder / 'first_person.png')
  carrying.draw(folder / 'carrying.png')
  worlds.draw(folder / 'worlds')
  worlds.draw_sheet(folder / 'worlds.png')
  registers.draw(folder / 'registers')
  (folder / 'gallery').mkdir(exist_ok=True)
  if flags.INPUT.value is None:
    program.say('tampering.gif is left out: --input names no sweep')
  else:
    tampering.draw(folder / 'tampering.gif', pathlib.Path(flags.INPUT.value))
  program.say(f'The pictures are in {folder}')


if __name__ == '__main__':
  program.start(main)
