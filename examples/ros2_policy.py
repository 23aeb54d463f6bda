"""A ROS 2 node that runs the policy of a map: ``python ros2_policy.py policy.npz COLUMNS CELL_SIZE``.

Whenever the robot has finished a move, its pose arrives on ``arrived``; the next action is published
on ``action`` by its name, such as "up", for the robot's own motion controller. `Driver` has the logic
and needs NumPy alone; `main` connects it to ROS, for which rclpy comes with a ROS installation.
"""

import sys

import jaxltl as jl


class Driver:
    """The policy of a map of square cells, row by row from the upper left corner.

    Args:
      path: a file of `jaxltl learn` or `jl.io.save_policy`.
      columns, cell_size: the width of the map in cells, and of a cell in metres.
      seed: of the actions of a stochastic policy.
    """

    def __init__(self, path, columns, cell_size, seed=0):
        self.controller = jl.io.load_policy(path).controller(seed)
        self.columns, self.cell_size, self.started = columns, cell_size, False

    def cell(self, x, y):
        """The number of the cell at a position in metres; y points up from the upper edge."""
        column, row = int(x // self.cell_size), int(-y // self.cell_size)
        if not 0 <= column < self.columns or row < 0:
            raise ValueError(
                f"position ({x:g}, {y:g}) is not on the map of {self.columns} columns."
            )
        return row * self.columns + column

    def arrived(self, x, y):
        """The name of the next action, after a move that ended at a position."""
        read = self.controller.update if self.started else self.controller.start
        read(self.cell(x, y))
        self.started = True
        action = self.controller.act()
        return self.controller.policy.actions[action]


def main(arguments):
    """Spins the node until it is interrupted."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import String

    path, columns, cell_size = arguments
    driver = Driver(path, int(columns), float(cell_size))
    rclpy.init()
    node = rclpy.create_node("jaxltl_policy")
    publisher = node.create_publisher(String, "action", 10)

    def on_arrival(message):
        position = message.pose.position
        publisher.publish(String(data=driver.arrived(position.x, position.y)))

    node.create_subscription(PoseStamped, "arrived", on_arrival, 10)
    rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1:])
