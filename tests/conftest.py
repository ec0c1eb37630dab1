"""What holds for every test."""

import signal


def pytest_configure():
    # A shell starts what runs behind it with Ctrl-C ignored, which programs inherit; those that the
    # tests start and interrupt are to meet it as in a terminal.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
