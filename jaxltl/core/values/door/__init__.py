"""One door for questions: a question and a model are answered by the engine that a table names."""
