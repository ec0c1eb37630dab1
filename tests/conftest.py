"""What holds for every test."""

import signal


def pytest_configure():
    # A shell starts what runs behind it with these ignored, which programs inherit; those that the
    # tests start and interrupt are to meet them as in a terminal.
    for name in ("SIGINT", "SIGQUIT"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
