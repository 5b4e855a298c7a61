"""What the rules of the sync protocol are worth: each is switched off, and a test must fail.

    $ python -m tests.rules_off            # all of them, in a copy of the tree; about ten minutes
    $ python -m tests.rules_off 5 9        # of two rules

The table is `switches.SWITCHES`: rule, how it is switched off, and the test that notices.
"""
