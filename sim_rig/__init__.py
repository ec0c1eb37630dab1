"""Physics of the hybrid actuator, its process models, and the simulated rig."""
