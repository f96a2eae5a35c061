"""The shard schema, stages and the step-indexed loader."""
