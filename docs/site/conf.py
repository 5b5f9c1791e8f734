"""Configuration of the site: Markdown, notebooks and an API reference.

Run from the root of the repository, whose files are the sources:

  python -m sphinx -W -c docs/site . build/site
"""

import pathlib
import sys

_ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(_ROOT), str(_ROOT / 'docs' / 'site')]

project = 'realab_suite'
author = 'The realab_suite authors'
extensions = [
    'myst_nb',
    'sphinx.ext.autodoc',
    'sphinx.ext.napoleon',
    'catalogue',
]
root_doc = 'docs/site/index'
# `catalogue` writes the pages in `build`.
include_patterns = [
    'README.md',
    'GLOSSARY.md',
    'CHANGELOG.md',
    'CONTRIBUTING.md',
    'benchmarks/README.md',
    'docs/*.md',
    'docs/notebooks/*.ipynb',
    'docs/site/*.md',
    'build/catalogue/**.md',
    'build/catalogue/**.rst',
]
source_suffix = {
    '.md': 'myst-nb',
    '.ipynb': 'myst-nb',
    '.rst': 'restructuredtext',
}
# The pages show the stored outputs of notebooks; tests execute them.
nb_execution_mode = 'off'
myst_heading_anchors = 4
# The default language of code blocks without one.
highlight_language = 'none'
html_theme = 'furo'
html_title = 'realab_suite'
html_copy_source = False
# Docstrings use single backticks for code.
default_role = 'code'
autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
autodoc_default_options = {'members': True, 'show-inheritance': True}
# Docstrings of dm_control are in another markup.
autodoc_inherit_docstrings = False
# Packages of extras that the site does without.
autodoc_mock_imports = [
    'minari',
    'stable_baselines3',
]
napoleon_use_ivar = True
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True
# Words such as `seed` in lists of fields are no references.
suppress_warnings = ['ref.python']
