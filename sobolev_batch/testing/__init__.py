"""Testing: is this surface the same as that one, to a tolerance?

In: two surfaces and an rtol. Out: a verdict, an assertion of test suites, and files that show where they differ.
"""
