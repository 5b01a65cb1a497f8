"""What `fieldkit check` looks at: a shell script asks each robot once, pure functions judge what it said."""
