"""All planted leaks, one for each channel: campaign C09.

Channels that cannot exist within one process, or that are declared, are in
`NOT_HERE`, with the reason.
"""

from tests.leaks import planting
from tests.leaks import view_mutants  # noqa: F401 - plants its leaks.
from tests.leaks import world_mutants  # noqa: F401 - plants its leaks.

Check = planting.Check
Mutant = planting.Mutant
MUTANTS = planting.MUTANTS
found_by = planting.found_by

NOT_HERE = {
    'L31': 'within one process nothing keeps code from looking: no promise',
    'L32': 'served environments',
    'L33': 'served environments',
    'L34': 'served environments',
    'L35': 'served environments',
    'L36': 'served environments; no promise',
    'L39': 'declared: a provider is trusted with what it reads',
}
