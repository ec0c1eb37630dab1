"""The serial rig: wire protocol (docs/serial-protocol.md), both its ends, and the backend."""
