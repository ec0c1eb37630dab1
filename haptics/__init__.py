"""From identified parameters to the torque a hand feels: controllers, and experiments on them."""
