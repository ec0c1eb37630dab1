"""What stands between the plant and the host: converters, encoder, queue, interlock, user."""
