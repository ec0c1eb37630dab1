"""One run: a protocol asked for commands, a rig sampled, limits watched, everything logged.

The way of a run: ``plan`` asks the protocol (``protocol``) what it will do and checks that against
the rig's limits. ``runner`` then takes the rig through the phases of ``daq.hal.Phase``: it opens
the device, asks for real-time scheduling (``realtime``) and goes on by ``phases``: it averages
the inputs at zero command, waits until the load is wound, plays the waveform or answers every
sample, zeroes the outputs and closes. In every phase samples come by way of ``sampling``, which
shows them to the limits first; those of the run phase are logged before the next are waited for,
and ``timing`` notes how punctual they were. Whatever ends a run early, a signal (``signals``)
included, the outputs are zeroed first and the capture folder says why.
"""
