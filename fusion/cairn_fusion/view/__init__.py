"""What an operator sees: temperature on colour and colour on temperature, in pictures and as a live stream."""
