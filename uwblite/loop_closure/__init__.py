"""Loop closures (paper: step 2): candidates, matching, verification."""
