"""Keep stored segments and acknowledged heads, to refill a log that went back."""
