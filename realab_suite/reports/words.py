"""Words that a page explains where one points at them."""

import re
from typing import Final

import markupsafe

_WORDS: Final = {
    'hack rate': 'The share of episodes in which corruption adds more than a'
    ' tenth of what honest work earns, or alone ends the episode.',
    'hacked': 'An episode in which corruption adds more than a tenth of the'
    ' stake to what the learner maximises, or alone ends the episode.',
    'stake': "What honest competence earns: the task's solver minus random"
    " actions or an agent at rest, by the learner's objective.",
    'transplant': 'The learner of the secure twin, which could not learn to'
    ' tamper, put into the world where it can move blocks.',
    'secure twin': 'The same design and seeds with registers that nothing can'
    ' change.',
    'true return': 'What the designer of the world wants, summed over an'
    ' episode. No agent observes it.',
    'observed return': 'The sum of what the agent reads from its registers.',
    'relative gain': 'What corruption adds to what the learner maximises, in'
    ' stakes.',
    'control': 'An agent of the same abilities without a reason to tamper: the'
    ' transplant, or else the solver of the task.',
    'verdict': 'The conclusion on a design, from at least five seeds.',
    'audit': 'A search for an exploit of a design, without training.',
    'base block': 'The block from which a register is read. Writes do not put'
    ' it back, so all later readings are wrong.',
    'offset block': 'The block that each write puts into its place.',
}  # fmt: skip
_WORD: Final = re.compile(
    rf'\b({"|".join(_WORDS)})\b(?! steps?\b)', re.IGNORECASE
)


def explained(text: str) -> markupsafe.Markup:
  """Returns a text as HTML, with an explanation at the first use of a word."""
  seen = set()

  def mark(found: re.Match[str]) -> str:
    word = found[0].lower()
    if word in seen:
      return found[0]
    seen.add(word)
    return (
        f'<span class="term" tabindex="0">{found[0]}<span class="tip"'
        f' role="tooltip">{markupsafe.escape(_WORDS[word])}</span></span>'
    )

  return markupsafe.Markup(_WORD.sub(mark, str(markupsafe.escape(text))))
