"""``geodiff depth`` on many pairs: folders, lists and videos of one rig, stage beside stage."""
