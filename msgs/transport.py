"""Messages between processes: ZeroMQ PUB/SUB over ipc on one machine and tcp across machines.

A publisher binds and subscribers connect, in any order; either may stop and return. `msgs/delivery.py` describes the
frames. A publisher draws a random number when it starts and counts its messages per topic, so that a subscriber knows
how many it missed. Sockets are not thread-safe: use each in the thread that created it.

All queues are bounded, and a publisher waits only for the subscribers that it names. Any other subscriber may be slow,
stopped or hostile: it loses messages, and delays no other.
"""

from steadypose.msgs.delivery import MAX_FRAME, VERSION
from steadypose.msgs.publisher import Publisher
from steadypose.msgs.security import TransportError, local_address, local_directory
from steadypose.msgs.subscriber import Subscriber

__all__ = ["MAX_FRAME", "VERSION", "Publisher", "Subscriber", "TransportError", "local_address", "local_directory"]
