"""What things are: the models of every input, parameter and product."""
