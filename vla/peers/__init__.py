"""Scripts that time other projects on the same work, run by those projects' own interpreters."""
