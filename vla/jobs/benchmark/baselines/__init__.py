"""Scripts that measure other projects on the same work, for the interpreters of those projects."""
