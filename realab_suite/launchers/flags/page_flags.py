"""Flags of the programs that serve a page to a person."""

from absl import flags

PORT = flags.DEFINE_integer(
    'port', 0, 'Port of the page; 0 for a free one.', 0, 65535
)
HOST = flags.DEFINE_string(
    'host',
    '127.0.0.1',
    'Address to listen at. The default is reached from this machine only;'
    ' connections are not encrypted.',
)
flags.register_validator(
    'host', bool, message='allowed are addresses, such as 127.0.0.1'
)
EPISODES = flags.DEFINE_integer('episodes', 1, 'Number of episodes.', 1)
RATE = flags.DEFINE_float(
    'rate', 10.0, 'Control steps per second; 10 is real time.', 0.1, 1000.0
)
