"""The mathematics: models, automata, products, and the solvers on them."""
