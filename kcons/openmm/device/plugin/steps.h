// A time step as a list of actions. What a GPU needs is in common_platform.cpp.
#pragma once
#include "openmm/Integrator.h"
#include "openmm/OpenMMException.h"
#include "openmm/System.h"
#include "openmm/internal/ContextImpl.h"
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

namespace kcons {

using namespace OpenMM;
using namespace std;

// An array that kernels know by its name; `saved` if it belongs to a state, `passed` if it is an argument of theirs.
struct Array {
    string name;
    bool whole, saved, passed;     // whole numbers
    vector<double> values;         // that it begins with
};

// Launches a kernel, or, where it has no name, evaluates forces of groups, a bit mask, and keeps them in a slot.
struct Action {
    string kernel;
    int groups, slot;
};

// What Python reads and writes directly.
struct Shared {
    int whole = 1;                 // whether others look at velocities between steps, which must then end
    int every = 0, since = 0;      // steps from one record to the next, 0 for none, and the step that they count from
    int moved = 0;                 // whether others have set positions or velocities since the last step
    int bound = 0, planned = 0;    // whether there is a Context, and whether it has its kernels; not after reinitialize
    double origin = 0;             // time that kernels count from
    double told[7] = {};           // by the kernel `look`, at the end of the last call: 1 is -1 where it tells nothing
};

// Steps in one Context: what Python makes of an integrator for it, and how a platform runs that. n steps are the head,
// n-1 times the middle, which is the end of a step and the head of the next, and the tail.
class Steps {
public:
    virtual ~Steps() {}
    // What there is: masses; i, j and length of each constraint; positions, box (zeros if there is none) and time.
    map<string, vector<double>> given;
    string source, library;        // of the kernels; for plain C++ the file that they were compiled to
    vector<Array> arrays;
    vector<Action> parts[3];
    int items = 0, workGroup = 64, slots = 1;
    bool valid = false;            // whether forces are those at the present positions
    long long last = 0;            // the step that the last call ended with; 0 where a checkpoint brought its own noise
    virtual void prepare(ContextImpl& c) = 0;
    virtual vector<double> read(const string& name) = 0;
    virtual void write(const string& name, const vector<double>& values) = 0;
    virtual void launch(const string& kernel) = 0;
    virtual void execute(ContextImpl& c, const Integrator& integrator, const Shared& shared, int steps) {
        numbers.dt = integrator.getStepSize();
        numbers.tolerance = integrator.getConstraintTolerance();
        if (c.getStepCount() < last)               // others went back, and the same noise would come again
            write("seed", {fmod(read("seed")[0]+1140071481, 2147483647)});
        bool ended = true;                         // whether velocities are those of the end of a step
        for (int k = 0; k < steps; k++) {
            if (c.updateContextState()) valid = false;     // barostats have moved positions
            const Vec3 before[] = {numbers.box[0], numbers.box[1], numbers.box[2]};
            c.getPeriodicBoxVectors(numbers.box[0], numbers.box[1], numbers.box[2]);
            if (!equal(before, before+3, numbers.box)) valid = false;
            if (!valid || (slots == 1 && c.getLastForceGroups() != parts[0].back().groups)) {
                positionsMoved();
                vector<bool> known(slots);
                for (int part : {0, 1}) for (auto& action : parts[part])
                    if (action.kernel.empty() && !known[action.slot]) { evaluate(c, action); known[action.slot] = true; }
            }
            run(c, shared, ended ? 0 : 1);
            c.setTime(c.getTime()+numbers.dt);
            c.setStepCount(c.getStepCount()+1);
            const long long made = c.getStepCount()-shared.since;
            bool recorded = shared.every > 0 && made % shared.every == 0;
            ended = k == steps-1 || shared.whole || recorded;
            if (ended) run(c, shared, 2);
            if (recorded) { numbers.step = made/shared.every-1; launch("record"); }
        }
        last = c.getStepCount();
        launch("look");
    }
protected:
    struct Numbers { int step, launch; double dt, time, tolerance; Vec3 box[3]; };
    Numbers numbers = {};
    // Refuses values of another number.
    Array& declared(const string& name, long size = -1) {
        for (auto& array : arrays) if (array.name == name) {
            if (size < 0 || size == (long) array.values.size()) return array;
            throw OpenMMException("kcons: '"+name+"' has "+to_string(array.values.size())+" values, not "+to_string(size));
        }
        throw OpenMMException("kcons: no array is called '"+name+"'");
    }
    virtual void positionsMoved() {}           // before the first evaluation at new positions
    virtual void keepForces(int slot) = 0;     // where there are several groups
private:
    void run(ContextImpl& c, const Shared& shared, int part) {
        numbers.time = c.getTime()-shared.origin;
        numbers.step = (int) c.getStepCount();
        bool moved = false;
        for (auto& action : parts[part]) {
            if (!action.kernel.empty()) launch(action.kernel);
            // Atoms may take new places only where no forces are kept that are still needed.
            else if (moved) { c.computeVirtualSites(); positionsMoved(); }
            moved = !action.kernel.empty();
            if (!moved) evaluate(c, action);
        }
    }
    void evaluate(ContextImpl& c, const Action& action) {
        c.calcForcesAndEnergy(true, false, action.groups);
        if (slots > 1) keepForces(action.slot);
        valid = true;
    }
};

// By platform; given are pairs of atoms that stay together, beside those of constraints of the System.
typedef function<Steps*(ContextImpl& c, const vector<int>& tied)> Maker;
map<string, Maker>& makers();

}
