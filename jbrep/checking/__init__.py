"""`jbrep check`: what a robot's observations, actions and rewards need before anything learns."""
