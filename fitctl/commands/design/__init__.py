"""Commands that identify a rig, design its controllers and simulate it."""
