"""Many runs of one rig, compiled."""
