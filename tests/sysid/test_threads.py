"""Threads that wait for tasks, and a program that ends in spite of them."""

import subprocess
import sys

CUT_SHORT = """
import concurrent.futures.thread as pools
from sysid.threads import Workers

class CutShort(type(pools._threads_queues)):
    def __setitem__(self, thread, queue):
        raise KeyboardInterrupt  # a thread has begun, and the pool does not know it yet

pools._threads_queues = CutShort()
workers = Workers(2)
try:
    workers.each(lambda task: None, [1, 2])
except KeyboardInterrupt:
    print("stopped")
"""


def test_a_program_stopped_while_a_thread_begins_ends():
    done = subprocess.run(
        [sys.executable, "-c", CUT_SHORT], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "stopped\n"
