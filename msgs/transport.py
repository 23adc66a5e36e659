"""Messages between processes: ZeroMQ PUB/SUB over ipc on one machine and tcp across machines.

A publisher binds, subscribers connect, in any order; either may go and come back. What is in a frame stands in
`msgs/delivery.py`. The publisher draws its number when it starts and counts its messages per topic, so that a
subscriber knows what it missed. Sockets are not thread-safe: use each in the thread that made it.

Queues are bounded everywhere, and a publisher waits only for the subscribers that it names. Any other may be slow,
stopped or hostile: it loses messages, and delays no other.
"""

from steadypose.msgs.delivery import MAX_FRAME, VERSION
from steadypose.msgs.publisher import Publisher
from steadypose.msgs.security import TransportError, local_address, local_directory
from steadypose.msgs.subscriber import Subscriber

__all__ = ["MAX_FRAME", "VERSION", "Publisher", "Subscriber", "TransportError", "local_address", "local_directory"]
