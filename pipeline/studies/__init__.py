"""What settings cost and change: accuracy against time, effects one by one."""
