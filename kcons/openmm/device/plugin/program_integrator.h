// A time step as a list of actions, as an OpenMM::Integrator. What a GPU needs is in common_platform.cpp.
#pragma once
#include "openmm/Integrator.h"
#include "openmm/OpenMMException.h"
#include "openmm/System.h"
#include "openmm/internal/ContextImpl.h"
#include <functional>
#include <map>
#include <memory>
#include <ostream>
#include <string>
#include <vector>

namespace kcons {

// An array that kernels know by its name; `saved` if it belongs to a state, `passed` if it is an argument of theirs.
struct Array {
    std::string name;
    bool whole, saved, passed;     // whole numbers
    std::vector<double> values;    // that it begins with
};

// Launches a kernel, or, where it has no name, evaluates forces of groups, a bit mask, and keeps them in a slot.
struct Action {
    std::string kernel;
    int groups, slot;
};

// What Python reads and writes directly.
struct Shared {
    int whole = 1;                 // whether others look at velocities between steps, which must then end
    int noisy = 0;                 // whether the kinetic energy is that of the middle of the last step
    int every = 0, since = 0;      // steps from one record to the next, 0 for none, and the step that they count from
    int moved = 0;                 // whether others have set positions or velocities since the last step
    int bound = 0, planned = 0;    // whether there is a Context, and whether it has its kernels; not after reinitialize
    double origin = 0;             // time that kernels count from
    double told[7] = {};           // by the kernel `look`, at the end of the last call
};

// Steps in one Context: what Python makes of an integrator for it, and how a platform runs that. n steps are the head,
// n-1 times the middle, which is the end of a step and the head of the next, and the tail.
class Steps {
public:
    virtual ~Steps() {}
    // What there is: masses; i, j and length of each constraint; positions, box (zeros if there is none) and time.
    std::map<std::string, std::vector<double>> given;
    std::string source, library;   // of the kernels; for plain C++ the file that they were compiled to
    std::vector<Array> arrays;
    std::vector<Action> parts[3];
    int items = 0, workGroup = 64, slots = 1;
    bool valid = false;            // whether forces are those at the present positions
    long long last = 0;            // the step that the last call ended with; 0 where a state brought its own noise
    virtual void prepare(OpenMM::ContextImpl& c) = 0;
    virtual void execute(OpenMM::ContextImpl& c, const OpenMM::Integrator& integrator, const Shared& shared, int steps);
    virtual std::vector<double> read(const std::string& name) = 0;
    virtual void write(const std::string& name, const std::vector<double>& values) = 0;
    virtual void launch(const std::string& kernel) = 0;
protected:
    struct Numbers { int step, launch; double dt, time, tolerance; OpenMM::Vec3 box[3]; };
    Numbers numbers = {};
    const Array& declared(const std::string& name, long size = -1) const;   // refuses values of another number
    virtual void positionsMoved() {}           // before the first evaluation at new positions
    virtual void keepForces(int slot) = 0;     // where there are several groups
private:
    void run(OpenMM::ContextImpl& c, const Shared& shared, int part);
    void evaluate(OpenMM::ContextImpl& c, const Action& action);
};

// By platform; given are pairs of atoms that stay together, beside those of constraints of the System.
typedef std::function<Steps*(OpenMM::ContextImpl& c, const std::vector<int>& tied)> Maker;
std::map<std::string, Maker>& makers();

class ProgramIntegrator : public OpenMM::Integrator {
public:
    std::string description;       // what Python makes steps of
    std::vector<int> tied;
    mutable Shared shared;
    void step(int steps) override;
    Steps& prepared() const;       // with all that they need, which is made when it is used first
protected:
    void initialize(OpenMM::ContextImpl& c) override;
    void cleanup() override;
    std::vector<std::string> getKernelNames() override { return {}; }
    void stateChanged(OpenMM::State::DataType changed) override;
    double computeKineticEnergy() override;
    bool kineticEnergyRequiresForce() const override { return false; }
    void createCheckpoint(std::ostream& out) const override { out << saved() << '\n'; }
    void loadCheckpoint(std::istream& in) override;
    void serializeParameters(OpenMM::SerializationNode& node) const override;
    void deserializeParameters(const OpenMM::SerializationNode& node) override;
private:
    std::string saved() const;     // all that belongs to a state beside x and v: numbers
    // `exactly` that of these rows; else arrays of other rows stay as they are.
    void restore(const std::string& text, bool exactly);
    std::unique_ptr<Steps> steps;
    // Of the middle of the last step, and of the velocities that it ended with: those of others have another. -1: none.
    double middleKinetic = -1, endKinetic = -1;
};

}
