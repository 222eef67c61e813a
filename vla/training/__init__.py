"""Everything that runs inside `Trainer.fit`."""
