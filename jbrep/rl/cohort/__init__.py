"""Many agents of one algorithm that learn together, each as it would alone."""
